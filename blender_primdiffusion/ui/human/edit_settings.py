"""What the edits in the panel Human ask for; saved with the scene."""

from __future__ import annotations

import bpy

from ...formats.requests import AMOUNT, FRACTION, PARTS, TRANSFERS
from ...scene.human import MARK, humans
from ..generate.attributes import PRIMDIFFUSION_PG_attributes, title
from ..translations import CONTEXT

PAINTED_GROUP = "PrimDiffusion Region"
"""Vertex group of the body mesh that Paint Region makes."""

_TRANSFERS = {
    "texture": ("Texture", "Colours alone, on the person's own shape"),
    "garment": ("Garment", "Colours and shape: what the other person wears there"),
}
TRANSFER_ITEMS = [(name, *_TRANSFERS[name]) for name in TRANSFERS]


def parts_property():
    """Several parts of the body may be chosen."""
    return bpy.props.EnumProperty(
        name="Parts",
        translation_context=CONTEXT,
        description="What to change: Shift-click for several. A person's left and right",
        items=[(name, title(name), "", 1 << i) for i, name in enumerate(PARTS)],
        options={"ENUM_FLAG", "SKIP_SAVE"},
        default={"top"},
    )


def _may_be_other(_self: PRIMDIFFUSION_PG_edit, collection: bpy.types.Collection) -> bool:
    return MARK in collection and collection in humans(bpy.context.scene)


class PRIMDIFFUSION_PG_edit(bpy.types.PropertyGroup):
    """`scene.primdiffusion_edit`."""

    seed: bpy.props.IntProperty(
        name="Seed", description="Another seed is another result; the same seed is the same", default=1, min=0
    )
    amount: bpy.props.FloatProperty(
        name="Amount",
        description="How far the new person may be from this one: 0 is the same, 1 anybody",
        default=AMOUNT,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    region: bpy.props.EnumProperty(
        name="Region",
        description="Where to change the person; everything else stays exactly as it is",
        items=[
            ("PARTS", "Parts", "Parts of the body, by name"),
            ("PAINTED", "Painted", "A vertex group of the body mesh: where its weight is one half or more"),
        ],
    )
    parts: parts_property()
    vertex_group: bpy.props.StringProperty(
        name="Vertex Group", description="Of the body mesh of the person", default=PAINTED_GROUP
    )
    attributes: bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_attributes)
    other: bpy.props.PointerProperty(
        name="Other Person", description="From whom", type=bpy.types.Collection, poll=_may_be_other
    )
    what: bpy.props.EnumProperty(name="Transfer", description="What the person gets", items=TRANSFER_ITEMS)
    harmonise: bpy.props.FloatProperty(
        name="Harmonise",
        description="How much the region is denoised once more to fit the rest of the person: 0 copies it exactly",
        default=0.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    fraction: bpy.props.FloatProperty(
        name="Fraction",
        translation_context=CONTEXT,
        description="How much of the other person: 0 is this one, 1 the other",
        default=FRACTION,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
