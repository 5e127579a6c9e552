"""Vary, Re-dress Region, Transfer Texture and Blend: edits of the selected person, in place.

What a script does not give is the panel's. None is redoable: moving a redo slider must not start an expensive job
again; the result makes one undo step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bpy

from ...formats.requests import STEPS
from ...scene.files import person_file
from ...scene.human import body_of, humans
from ..generate.attributes import asked, parsed
from ..jobs.follow import submit
from ..jobs.target import named_person, selected_person
from ..translations import CONTEXT
from .edit_settings import TRANSFER_ITEMS, parts_property

if TYPE_CHECKING:
    from .edit_work import EditWork

_HUMAN = "Name of the person to edit (of their collection); empty: the selected one"
_PANELS = "Not given: the panel's"
_SKIP = {"SKIP_SAVE"}


class _Edit:
    """What the edits have in common."""

    bl_options: set[str] = set()  # noqa: RUF012  neither REGISTER (redo) nor UNDO (the result has one)
    human: bpy.props.StringProperty(name="Person", description=_HUMAN, options=_SKIP)
    seed: bpy.props.IntProperty(name="Seed", min=0, description=_PANELS, options=_SKIP)
    steps: bpy.props.IntProperty(name="Steps", min=1, max=1000, default=STEPS, description=_PANELS, options=_SKIP)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is somebody to edit."""
        cls.poll_message_set("Nobody is in the scene: generate a person first")
        return bool(humans(context.scene))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put it in line; in background mode this waits for the edited person."""
        try:
            person = named_person(context, self.human) if self.human else selected_person(context)
            steps = self.chosen("steps", context.scene.primdiffusion)
            work = self.work().of(person, steps, self.params(context, person))
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return submit(self, context, work)

    def params(self, context: bpy.types.Context, person: bpy.types.Collection) -> dict[str, Any]:
        """Of the child's method, with the edit's own ones only (see `EditWork.asked`)."""
        raise NotImplementedError

    def work(self) -> type[EditWork]:
        """What is put in line."""
        raise NotImplementedError

    def chosen(self, name: str, settings: bpy.types.PropertyGroup) -> Any:
        """What the script gives, else what the panel holds."""
        return getattr(self if self.properties.is_property_set(name) else settings, name)


class _Region:
    """Where to edit."""

    parts: parts_property()
    vertex_group: bpy.props.StringProperty(
        name="Vertex Group", description="A painted region instead of parts", options=_SKIP
    )

    def region(
        self, settings: bpy.types.PropertyGroup, person: bpy.types.Collection
    ) -> list[str] | dict[str, list[float]]:
        """Names of parts, or painted weights [V]."""
        from ...scene.painting import painted_weights

        given = self.properties.is_property_set
        if given("vertex_group") or (not given("parts") and settings.region == "PAINTED"):
            body = body_of(person)
            if body is None:
                raise ValueError(f"the body mesh of {person.name!r} was deleted: choose parts by name instead")
            return {"painted": painted_weights(body, self.chosen("vertex_group", settings)).tolist()}
        parts = sorted(self.chosen("parts", settings))
        if not parts:
            raise ValueError("no part of the body is chosen: choose one or more in the panel")
        return parts


class PRIMDIFFUSION_OT_vary(_Edit, bpy.types.Operator):
    """Turn the selected person into a neighbour: similar, more so the smaller the amount"""

    bl_idname = "primdiffusion.vary"
    bl_label = "Vary"

    amount: bpy.props.FloatProperty(name="Amount", min=0.0, max=1.0, description=_PANELS, options=_SKIP)
    attributes: bpy.props.StringProperty(
        name="Attributes", description="Like sex=female, height=1.7; empty: whatever comes", options=_SKIP
    )
    guidance: bpy.props.FloatProperty(name="Guidance", min=0.0, max=20.0, description=_PANELS, options=_SKIP)

    def work(self) -> type[EditWork]:
        """Vary."""
        from .edit_work import VaryWork

        return VaryWork

    def params(self, context: bpy.types.Context, _person: bpy.types.Collection) -> dict[str, Any]:
        """Of the child's method vary."""
        settings = context.scene.primdiffusion_edit
        params = {"amount": self.chosen("amount", settings), "seed": self.chosen("seed", settings)}
        wanted = parsed(self.attributes)
        if wanted:
            params |= {"attributes": wanted, "guidance": self.chosen("guidance", context.scene.primdiffusion)}
        return params


class PRIMDIFFUSION_OT_redress(_Region, _Edit, bpy.types.Operator):
    """Generate a region of the selected person anew; everything else stays exactly as it is"""

    bl_idname = "primdiffusion.redress"
    bl_label = "Re-dress Region"

    attributes: bpy.props.StringProperty(name="Attributes", description=f"Like outfit=suit. {_PANELS}", options=_SKIP)
    guidance: bpy.props.FloatProperty(name="Guidance", min=0.0, max=20.0, description=_PANELS, options=_SKIP)

    def work(self) -> type[EditWork]:
        """Re-dress Region."""
        from .edit_work import RedressWork

        return RedressWork

    def params(self, context: bpy.types.Context, person: bpy.types.Collection) -> dict[str, Any]:
        """Of the child's method inpaint."""
        settings = context.scene.primdiffusion_edit
        params: dict[str, Any] = {"region": self.region(settings, person), "seed": self.chosen("seed", settings)}
        given = self.properties.is_property_set("attributes")
        wanted = parsed(self.attributes) if given else asked(settings.attributes)
        if wanted:
            params |= {"attributes": wanted, "guidance": self.chosen("guidance", context.scene.primdiffusion)}
        return params


class PRIMDIFFUSION_OT_transfer_texture(_Region, _Edit, bpy.types.Operator):
    """Give a region of the selected person the texture of another one, or the garment"""

    bl_idname = "primdiffusion.transfer_texture"
    bl_label = "Transfer Texture"

    source: bpy.props.StringProperty(name="Source", description=f"Name of the other person. {_PANELS}", options=_SKIP)
    what: bpy.props.EnumProperty(name="Transfer", items=TRANSFER_ITEMS, description=_PANELS, options=_SKIP)
    harmonise: bpy.props.FloatProperty(name="Harmonise", min=0.0, max=1.0, description=_PANELS, options=_SKIP)

    def work(self) -> type[EditWork]:
        """Transfer Texture."""
        from .edit_work import TransferWork

        return TransferWork

    def params(self, context: bpy.types.Context, person: bpy.types.Collection) -> dict[str, Any]:
        """Of the child's method transfer."""
        settings = context.scene.primdiffusion_edit
        return {
            "source": _other(context, person, self.source),
            "region": self.region(settings, person),
            "what": self.chosen("what", settings),
            "harmonise": self.chosen("harmonise", settings),
            "seed": self.chosen("seed", settings),
        }


class PRIMDIFFUSION_OT_blend(_Edit, bpy.types.Operator):
    """Move the selected person towards another one, who stays as they are"""

    bl_idname = "primdiffusion.blend"
    bl_label = "Blend"

    other: bpy.props.StringProperty(name="Other", description=f"Name of the other person. {_PANELS}", options=_SKIP)
    fraction: bpy.props.FloatProperty(
        name="Fraction", translation_context=CONTEXT, min=0.0, max=1.0, description=_PANELS, options=_SKIP
    )

    def work(self) -> type[EditWork]:
        """Blend."""
        from .edit_work import BlendWork

        return BlendWork

    def params(self, context: bpy.types.Context, person: bpy.types.Collection) -> dict[str, Any]:
        """Of the child's method interpolate."""
        settings = context.scene.primdiffusion_edit
        other = _other(context, person, self.other)
        return {"other": other, "fraction": self.chosen("fraction", settings)}


def _other(context: bpy.types.Context, person: bpy.types.Collection, name: str) -> str:
    """The backend's file of the other person, named by a script or picked in the panel."""
    picked = context.scene.primdiffusion_edit.other
    if not name and picked is None:
        raise ValueError("choose the other person in the panel first")
    other = named_person(context, name or picked.name)
    if other == person:
        raise ValueError(f"{person.name!r} cannot be the other person too: choose somebody else")
    return str(person_file(other))


EDITS = (PRIMDIFFUSION_OT_vary, PRIMDIFFUSION_OT_redress, PRIMDIFFUSION_OT_transfer_texture, PRIMDIFFUSION_OT_blend)
