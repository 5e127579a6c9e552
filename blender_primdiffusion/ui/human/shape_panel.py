"""Shape and Details of the selected person: sub-panels of Human."""

from __future__ import annotations

import json

import bpy
from bpy.app.translations import pgettext_iface

from ...scene.human import BETAS, MARK, armature_of
from ...worker.sentence import sentence
from ..jobs.drawing import draw_lines
from ..jobs.target import selected_person

_SHOWN = ("seed", "steps", "sampler", "guidance", "checkpoint", "version")
"""Of the provenance, in this order."""
_ANIMATED = "The shape is animated: the exact engine draws it in each frame; bones and volumes keep one shape"


class _InHuman:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_parent_id = "PRIMDIFFUSION_PT_human"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Somebody is selected."""
        try:
            selected_person(context)
        except ValueError:
            return False
        return True


class PRIMDIFFUSION_PT_shape(_InHuman, bpy.types.Panel):
    """Height, weight and the sliders of the body's shape."""

    bl_label = "Shape"
    bl_order = 0

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        from ...scene.reshape import check_shapeable
        from ...scene.shape import has_custom_shape, shape_model_of
        from ...scene.shape_model import slider_names

        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
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
        column = layout.column(align=True)
        for index, name in enumerate(names):
            column.prop(settings, "betas", index=index, text=name, slider=True)
        row = layout.row(align=True)
        row.operator("primdiffusion.random_shape", text="Random", icon="FILE_REFRESH")
        reset = row.row(align=True)
        reset.enabled = has_custom_shape(person)
        reset.operator("primdiffusion.reset_shape", text="Reset", icon="LOOP_BACK")
        row = layout.row(align=True)
        row.prop(context.scene.primdiffusion_edit, "other", text="Copy From")
        copy = row.row(align=True)
        copy.enabled = context.scene.primdiffusion_edit.other is not None
        copy.operator("primdiffusion.copy_shape", text="", icon="PASTEDOWN")
        if _animated(armature):
            draw_lines(layout, _ANIMATED, "INFO")


class PRIMDIFFUSION_PT_details(_InHuman, bpy.types.Panel):
    """Where the selected person comes from and what they take."""

    bl_label = "Details"
    bl_order = 90
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        person = selected_person(context)
        column = self.layout.column(align=True)
        for name, value in details(person):
            column.label(text=f"{pgettext_iface(name)}: {value}", translate=False)


def details(person: bpy.types.Collection) -> list[tuple[str, str]]:
    """What Details says: names and values."""
    from ...scene.grid_cache import person_memory
    from ...scene.overlap import current_overlap

    provenance = json.loads(person[MARK])
    lines = [(name.capitalize(), f"{provenance[name]}") for name in _SHOWN if provenance.get(name) not in (None, "")]
    lines += [(name.capitalize(), f"{value}") for name, value in (provenance.get("attributes") or {}).items()]
    for edit in provenance.get("edits", ()):
        rest = ", ".join(
            f"{key} {value}" for key, value in edit.items() if key != "edit" and not isinstance(value, dict)
        )
        lines.append((f"Edit: {edit['edit']}", rest))
    volumes = [thing for thing in person.all_objects if thing.type == "VOLUME"]
    memory = person_memory(person)
    try:
        most = str(current_overlap(person))
    except (ValueError, KeyError, TypeError):  # changed by hand
        most = "?"
    lines.append(("Volumes", f"{len(volumes)}, up to {most} overlap"))
    lines.append(("Memory once drawn", f"{memory.grids / 1e6:.0f} MB"))
    lines.append(("Files", f"{memory.files / 1e6:.0f} MB"))
    return lines


def in_the_scene(scene: bpy.types.Scene, armature: bpy.types.Object, height: float) -> str:
    """How tall that is in the scene's units, with the armature's scale; empty where it is metres as they are."""
    units, scale = scene.unit_settings, armature.matrix_world.to_scale().z
    metric = units.system == "METRIC" and units.length_unit in ("METERS", "ADAPTIVE")
    if metric and abs(units.scale_length * scale - 1) < 1e-4:
        return ""
    if units.system == "NONE":
        return f"{height * scale:.3f} units"
    return bpy.utils.units.to_string(units.system, "LENGTH", height * scale * units.scale_length, precision=3)


def _animated(armature: bpy.types.Object) -> bool:
    """Keys or drivers move the betas."""
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
