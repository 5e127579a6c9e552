"""The section Edit of the panel Human: vary, re-dress, transfer and blend the selected human in place."""

from __future__ import annotations

from typing import Any

import bpy

from ..formats.requests import (
    PARTS,
    SIDED_PARTS,
    TRANSFERS,
    WHOLE_PARTS,
    InterpolateRequest,
    TransferRequest,
    VaryRequest,
)
from ..jobs.follow import Reporting, submit
from ..jobs.generate import EditJob
from ..scene.edit import end_painting, painted_weights, start_painting
from ..scene.human import BODY_MARK, body_of, humans, selected_person, session_file
from .declared import SKIP, declared
from .drawing import draw_job, draw_section
from .generate_settings import (
    PRIMDIFFUSION_PG_attributes,
    chosen_attributes,
    draw_attributes,
    seed_property,
    title,
)
from .on_person import HumanOperator, other_human

PAINTED_GROUP = "PrimDiffusion Region"
"""Vertex group of the body mesh that Paint Region makes."""

_TRANSFERS = {
    "texture": ("Texture", "Colours only, on the human's own shape"),
    "garment": ("Garment", "Colours and shape: what the other human wears there"),
}
TRANSFER_ITEMS = [(name, *_TRANSFERS[name]) for name in TRANSFERS]
PART_ITEMS = [(name, title(name), "", 1 << i) for i, name in enumerate(PARTS)]


class PRIMDIFFUSION_PG_edit(bpy.types.PropertyGroup):
    """`scene.primdiffusion_edit`."""

    __slots__ = ()
    kind: bpy.props.EnumProperty(
        name="Edit",
        description="What the panel does to the human",
        items=[
            ("VARY", "Vary", "A similar human"),
            ("REDRESS", "Re-dress", "A region of the human generated again"),
            ("TRANSFER", "Transfer", "Texture or garment of another human in a region"),
            ("BLEND", "Blend", "More like another human"),
        ],
    )
    seed: declared(VaryRequest, "seed", default=1)
    amount: declared(VaryRequest, "amount")
    region: bpy.props.EnumProperty(
        name="Region",
        description="Where to change the human; everything else stays exactly as it is",
        items=[
            ("PARTS", "Parts", "Parts of the body, by name"),
            ("PAINTED", "Painted", "A vertex group of the body mesh: where its weight is one half or more"),
        ],
    )
    parts: bpy.props.EnumProperty(
        name="Parts",
        description="Parts to change: Shift-click for several. Left and right are the human's",
        items=PART_ITEMS,
        options={"ENUM_FLAG", "SKIP_SAVE"},
        default={"top"},
    )
    vertex_group: bpy.props.StringProperty(
        name="Vertex Group", description="Vertex group of the human's body mesh", default=PAINTED_GROUP
    )
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)
    other: bpy.props.PointerProperty(
        name="Other Human",
        description="The other human",
        type=bpy.types.Object,
        poll=lambda _self, obj: obj in humans(bpy.context.scene),
    )
    what: bpy.props.EnumProperty(name="Transfer", description="What the human gets", items=TRANSFER_ITEMS)
    harmonise: declared(TransferRequest, "harmonise")
    fraction: declared(InterpolateRequest, "fraction")


class PRIMDIFFUSION_OT_paint_region(Reporting, bpy.types.Operator):
    """Show the body mesh of the selected human and paint the region to change"""

    bl_idname = "primdiffusion.paint_region"
    bl_label = "Paint Region"
    bl_options = {"UNDO"}
    described_by = ("finish",)

    finish: bpy.props.BoolProperty(
        name="Finish", description="Return to Object mode and hide the body mesh; its vertex group stays", options=SKIP
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.primdiffusion_edit
        if self.finish:
            if not painting(context):
                raise ValueError("no region is being painted: press Paint Region first")
            end_painting(context, context.view_layer.objects.active)
            return {"FINISHED"}
        person = selected_person(context)
        body = body_of(person)
        if body is None:
            raise ValueError(f"the body mesh of {person.name!r} was deleted: choose parts by name instead")
        start_painting(context, body, settings.vertex_group)
        settings.region = "PAINTED"
        return {"FINISHED"}


def painting(context: bpy.types.Context) -> bool:
    """Whether a body mesh is being weight painted."""
    active = context.view_layer.objects.active
    return active is not None and active.mode == "WEIGHT_PAINT" and BODY_MARK in active


class _Edit(HumanOperator):
    """Base of the edits, with the panel's settings."""

    method: str
    """The child's."""

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        params = {"steps": context.scene.primdiffusion.steps, **self.params(context, person)}
        return submit(self, context, EditJob.of(self.method, person, params))

    def params(self, context: bpy.types.Context, person: bpy.types.Object) -> dict[str, Any]:
        """The edit's parameters of the child's method: see `EditJob.asked`."""
        raise NotImplementedError


class _SeededEdit(_Edit):
    """Base of the edits that draw at random, from the operator's seed if it has one, else the panel's."""

    seed: seed_property()

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        if self.seed < 0:
            self.seed = context.scene.primdiffusion_edit.seed
        return super().run(context, person)


def _region(settings: bpy.types.PropertyGroup, person: bpy.types.Object) -> list[str] | dict[str, list[float]]:
    """Names of parts, or painted weights [V]. Raises ValueError."""
    if settings.region == "PAINTED":
        body = body_of(person)
        if body is None:
            raise ValueError(f"the body mesh of {person.name!r} was deleted: choose parts by name instead")
        return {"painted": painted_weights(body, settings.vertex_group).tolist()}
    if not settings.parts:
        raise ValueError("no part of the body is chosen: choose one or more in the panel")
    return sorted(settings.parts)


class PRIMDIFFUSION_OT_vary(_SeededEdit, bpy.types.Operator):
    """Turn the selected human into a similar one; the smaller the amount, the more similar"""

    bl_idname = "primdiffusion.vary"
    bl_label = "Vary"
    method = "vary"

    def params(self, context: bpy.types.Context, _person: bpy.types.Object) -> dict[str, Any]:
        settings = context.scene.primdiffusion_edit
        return {"amount": settings.amount, "seed": self.seed}


class PRIMDIFFUSION_OT_redress(_SeededEdit, bpy.types.Operator):
    """Generate a region of the selected human again; everything else stays exactly as it is"""

    bl_idname = "primdiffusion.redress"
    bl_label = "Regenerate Region"
    method = "inpaint"

    def params(self, context: bpy.types.Context, person: bpy.types.Object) -> dict[str, Any]:
        settings = context.scene.primdiffusion_edit
        params: dict[str, Any] = {"region": _region(settings, person), "seed": self.seed}
        if wanted := chosen_attributes(settings.attributes):
            params |= {"attributes": wanted, "guidance": context.scene.primdiffusion.guidance}
        return params


class PRIMDIFFUSION_OT_transfer_texture(_SeededEdit, bpy.types.Operator):
    """Transfer the texture, or the garment, of another human to a region of the selected human"""

    bl_idname = "primdiffusion.transfer_texture"
    bl_label = "Transfer Texture"
    method = "transfer"

    def params(self, context: bpy.types.Context, person: bpy.types.Object) -> dict[str, Any]:
        settings = context.scene.primdiffusion_edit
        return {
            "source": str(session_file(other_human(context, person))),
            "region": _region(settings, person),
            "what": settings.what,
            "harmonise": settings.harmonise,
            "seed": self.seed,
        }


class PRIMDIFFUSION_OT_blend(_Edit, bpy.types.Operator):
    """Change the selected human towards another one, which stays unchanged"""

    bl_idname = "primdiffusion.blend"
    bl_label = "Blend"
    method = "interpolate"

    def params(self, context: bpy.types.Context, person: bpy.types.Object) -> dict[str, Any]:
        other = other_human(context, person)
        return {"other": str(session_file(other)), "fraction": context.scene.primdiffusion_edit.fraction}


PROPERTIES = ((bpy.types.Scene, "primdiffusion_edit", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_edit)),)


def draw_edit(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Which edit, its settings and its button."""
    settings = context.scene.primdiffusion_edit
    row = layout.row(align=True)
    row.use_property_split = False  # with a label beside it words are cut short
    row.prop(settings, "kind", expand=True)
    _DRAW[settings.kind](layout, settings, context)


def _draw_vary(layout: bpy.types.UILayout, settings, _context) -> None:
    """How far, and the button."""
    layout.prop(settings, "amount")
    layout.prop(settings, "seed")
    draw_job(layout, "vary", "primdiffusion.vary", "MOD_NOISE")


def _draw_redress(layout: bpy.types.UILayout, settings, context) -> None:
    """Where, into what, and the button."""
    _draw_region(layout, settings, context)
    draw_attributes(layout, settings.attributes)
    layout.prop(settings, "seed")
    draw_job(layout, "inpaint", "primdiffusion.redress", "MATCLOTH")


def _draw_transfer(layout: bpy.types.UILayout, settings, context) -> None:
    """From whom, where, and the button."""
    layout.prop(settings, "other")
    _draw_region(layout, settings, context)
    layout.row().prop(settings, "what", expand=True)
    layout.prop(settings, "harmonise")
    if settings.harmonise > 0:
        layout.prop(settings, "seed")
    draw_job(layout, "transfer", "primdiffusion.transfer_texture", "TEXTURE", _reason(settings))


def _draw_blend(layout: bpy.types.UILayout, settings, _context) -> None:
    """The other human, the fraction and the button."""
    layout.prop(settings, "other")
    layout.prop(settings, "fraction")
    draw_job(layout, "interpolate", "primdiffusion.blend", "ARROW_LEFTRIGHT", _reason(settings))


def _reason(settings: bpy.types.PropertyGroup) -> str:
    return "" if settings.other is not None else "Choose the other human above."


def _draw_region(layout: bpy.types.UILayout, settings, context: bpy.types.Context) -> None:
    layout.row().prop(settings, "region", expand=True)
    if settings.region == "PARTS":
        _draw_parts(layout, settings, WHOLE_PARTS, 3)
        if (body := draw_section(layout, "sides", text="Left and Right")) is not None:
            _draw_parts(body, settings, SIDED_PARTS, 2)
        return
    try:
        mesh = body_of(selected_person(context))
    except ValueError:
        mesh = None
    if mesh is not None:
        layout.prop_search(settings, "vertex_group", mesh, "vertex_groups", text="Group")
    finish = painting(context)
    layout.operator(
        "primdiffusion.paint_region", text="Finish Painting" if finish else "Paint Region", icon="BRUSH_DATA"
    ).finish = finish


def _draw_parts(layout: bpy.types.UILayout, settings, parts: tuple[str, ...], columns: int) -> None:
    grid = layout.grid_flow(row_major=True, columns=columns, even_columns=True, align=True)
    grid.use_property_split = False
    for part in parts:
        grid.prop_enum(settings, "parts", part)


_DRAW = {"VARY": _draw_vary, "REDRESS": _draw_redress, "TRANSFER": _draw_transfer, "BLEND": _draw_blend}
