"""The panels Shape and Details of the selected human."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import bpy
from bpy.app.translations import pgettext_iface

from ..backend.requests import sentence
from ..jobs.target import named_person, selected_person
from ..scene.blend_values import as_shown
from ..scene.human import BETA_COUNT, BETAS, armature_of, humans, provenance_of
from .drawing import HUMAN, SidebarPanel, draw_lines, property_columns
from .on_person import SKIP, OnPerson
from .translations import CONTEXT

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FARTHEST = 3.0


class _Shape(OnPerson):
    """Base of the operators that change the shape; fast enough to be redone with other settings."""

    bl_options = {"REGISTER", "UNDO"}

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..scene.reshape import reshape  # needs numpy

        warning = reshape(person, self.betas_for(context, person))
        if warning:
            self.report({"WARNING"}, warning)
        return {"FINISHED"}

    def betas_for(self, context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        """The new shape [10]."""
        raise NotImplementedError


class PRIMDIFFUSION_OT_reshape(_Shape, bpy.types.Operator):
    """Set the body shape of the selected human: shape parameters, or a height and a weight"""

    bl_idname = "primdiffusion.reshape"
    bl_label = "Reshape Human"

    betas: bpy.props.FloatVectorProperty(
        name="Shape",
        size=BETA_COUNT,
        description="Shape parameters in standard deviations. Not given: unchanged",
        options=SKIP,
    )
    height: bpy.props.FloatProperty(name="Height (m)", description="Not given: any", options=SKIP)
    weight: bpy.props.FloatProperty(name="Weight (kg)", description="Not given: any", options=SKIP)

    def betas_for(self, _context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        import numpy as np  # needs numpy

        from ..scene.body_file import shape_model_of  # needs numpy
        from ..scene.shape import betas_of, betas_of_measures  # needs numpy

        given = self.properties.is_property_set
        betas = np.array(self.betas) if given("betas") else betas_of(person)
        height, weight = (getattr(self, name) if given(name) else None for name in ("height", "weight"))
        return betas_of_measures(shape_model_of(person), betas, height, weight)


class PRIMDIFFUSION_OT_reset_shape(_Shape, bpy.types.Operator):
    """Reset the selected human to the shape of the last edit, or of generation"""

    bl_idname = "primdiffusion.reset_shape"
    bl_label = "Reset Shape"

    def betas_for(self, _context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        from ..scene.shape import generated_betas  # needs numpy

        return generated_betas(person)


class PRIMDIFFUSION_OT_random_shape(_Shape, bpy.types.Operator):
    """Give the selected human a random body shape; the same seed gives the same shape"""

    bl_idname = "primdiffusion.random_shape"
    bl_label = "Random Shape"

    seed: bpy.props.IntProperty(name="Seed", description="Another seed gives another body", min=0)
    spread: bpy.props.FloatProperty(
        name="Spread",
        translation_context=CONTEXT,
        description="How far bodies differ from the mean body: 1 as real people do",
        default=1.0,
        min=0.0,
        max=2.0,
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        self.seed = random.randrange(2**31)
        return self.execute(context)

    def betas_for(self, _context: bpy.types.Context, _person: bpy.types.Collection) -> NDArray:
        import numpy as np  # needs numpy

        drawn = np.random.default_rng(self.seed).normal(0.0, self.spread, BETA_COUNT)
        return np.clip(drawn, -_FARTHEST, _FARTHEST)


class PRIMDIFFUSION_OT_copy_shape(_Shape, bpy.types.Operator):
    """Copy the body shape of the other human to the selected human"""

    bl_idname = "primdiffusion.copy_shape"
    bl_label = "Copy Shape"

    source: bpy.props.StringProperty(
        name="Source", description="Name of the other human. Not given: the panel's", options=SKIP
    )

    def betas_for(self, context: bpy.types.Context, person: bpy.types.Collection) -> NDArray:
        from ..scene.body_file import shape_model_of  # needs numpy
        from ..scene.shape import betas_of  # needs numpy

        picked = context.scene.primdiffusion_edit.other
        if not self.source and picked is None:
            raise ValueError("choose the other human in the panel first")
        other = named_person(context, self.source or picked.name)
        if other == person:
            raise ValueError(f"{person.name!r} cannot be the other human too: choose another one")
        if len(shape_model_of(other).template) != len(shape_model_of(person).template):
            raise ValueError(
                f"{other.name!r} stands on another body than {person.name!r}: their shape parameters are not comparable"
            )
        return betas_of(other)


_SHOWN = ("seed", "steps", "sampler", "guidance", "checkpoint", "version")
"""Fields of the provenance, in this order."""
_MOST_LINES = 60
"""Lines of Details about the provenance."""
_ANIMATED = "The shape is animated: the exact engine draws it in each frame; bones and volumes keep one shape"


class _InHuman(SidebarPanel):
    bl_category = HUMAN

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        try:
            selected_person(context)
        except ValueError:
            return False
        return True


class PRIMDIFFUSION_PT_shape(_InHuman, bpy.types.Panel):
    """Height, weight and the sliders of the body's shape."""

    bl_label = "Shape"
    bl_order = 1
    manual_page, manual_section = "editing", "shape"

    def draw(self, context: bpy.types.Context) -> None:
        # needs numpy
        from ..scene.body_file import shape_model_of
        from ..scene.reshape import check_shapeable
        from ..scene.shape import slider_names

        layout = property_columns(self.layout)
        person = selected_person(context)
        try:
            armature, names = armature_of(person), slider_names(shape_model_of(person))
            check_shapeable(person)
        except (OSError, ValueError) as error:
            draw_lines(layout, sentence(error), "INFO")
            return
        settings = armature.primdiffusion_human
        layout.prop(settings, "height")
        layout.prop(settings, "weight")
        shown = in_the_scene(context.scene, armature, settings.height)
        if shown:
            layout.label(text=f"In the scene: {shown}", icon="BLANK1", translate=False)
        _draw_sliders(layout, settings, {index: name for index, name in enumerate(names) if not name.isdecimal()})
        row = layout.row(align=True)
        row.operator("primdiffusion.random_shape", text="Random", icon="FILE_REFRESH")
        row.operator("primdiffusion.reset_shape", text="Reset", icon="LOOP_BACK")
        if len(humans(context.scene)) > 1:
            row = layout.row(align=True)
            row.prop(context.scene.primdiffusion_edit, "other", text="Copy From")
            if context.scene.primdiffusion_edit.other is not None:
                row.operator("primdiffusion.copy_shape", text="", icon="PASTEDOWN")
        if _animated(armature):
            draw_lines(layout, _ANIMATED, "INFO")
        header, body = layout.panel("primdiffusion_more_sliders", default_closed=True)
        header.label(text="More Sliders")
        if body is not None:
            _draw_sliders(body, settings, {index: name for index, name in enumerate(names) if name.isdecimal()})


class PRIMDIFFUSION_PT_details(_InHuman, bpy.types.Panel):
    """Provenance and memory of the selected human."""

    bl_label = "Details"
    bl_order = 90
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        person = selected_person(context)
        column = self.layout.column(align=True)
        for name, value in details(person):
            column.label(text=f"{pgettext_iface(name)}: {value}", translate=False)


def _draw_sliders(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, names: dict[int, str]) -> None:
    """Sliders of some betas, by their index."""
    column = layout.column(align=True) if names else layout  # an empty column leaves a gap
    for index, name in names.items():
        column.prop(settings, "betas", index=index, text=name, slider=True)


def details(person: bpy.types.Collection) -> list[tuple[str, str]]:
    """Names and values that Details shows."""
    # needs numpy
    from ..scene.cycles import current_overlap
    from ..scene.volumes import person_memory

    provenance = provenance_of(person)
    attributes, edits = provenance.get("attributes"), provenance.get("edits")
    shown = {name: provenance[name] for name in _SHOWN if provenance.get(name) not in (None, "")}
    lines = [(name.capitalize(), as_shown(value)) for name, value in shown.items()]
    if isinstance(attributes, dict):
        lines += [(as_shown(name.capitalize()), as_shown(value)) for name, value in attributes.items()]
    for edit in edits if isinstance(edits, list) else ():
        if isinstance(edit, dict):
            rest = [f"{key} {value}" for key, value in edit.items() if key != "edit" and not isinstance(value, dict)]
            lines.append((f"Edit: {as_shown(edit.get('edit', '?'))}", as_shown(", ".join(rest))))
    del lines[_MOST_LINES:]
    volumes = [obj for obj in person.all_objects if obj.type == "VOLUME"]
    memory = person_memory(person)
    try:
        most = str(current_overlap(person))
    except ValueError:  # changed by hand
        most = "?"
    lines.append(("Volumes", f"{len(volumes)}, up to {most} overlap"))
    lines.append(("Memory once drawn", f"{memory.grids / 1e6:.0f} MB"))
    lines.append(("Files", f"{memory.files / 1e6:.0f} MB"))
    return lines


def in_the_scene(scene: bpy.types.Scene, armature: bpy.types.Object, height: float) -> str:
    """The height in the scene's units, with the armature's scale; empty where that is the same in metres."""
    units, scale = scene.unit_settings, armature.matrix_world.to_scale().z
    metric = units.system == "METRIC" and units.length_unit in ("METERS", "ADAPTIVE")
    if metric and abs(units.scale_length * scale - 1) < 1e-4:
        return ""
    if units.system == "NONE":
        return f"{height * scale:.3f} units"
    return bpy.utils.units.to_string(units.system, "LENGTH", height * scale * units.scale_length, precision=3)


def _animated(armature: bpy.types.Object) -> bool:
    """Whether keys or drivers move the betas."""
    animation = armature.animation_data
    if animation is None:
        return False
    curves = list(animation.drivers)
    if animation.action is not None and animation.action_slot is not None:
        for layer in animation.action.layers:
            for strip in layer.strips:
                bag = strip.channelbag(animation.action_slot)
                curves += bag.fcurves if bag is not None else ()
    return any(curve.data_path == f'["{BETAS}"]' for curve in curves)
