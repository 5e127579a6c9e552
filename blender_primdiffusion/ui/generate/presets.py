"""Presets of the panel Generate: everything but the seed, as files in the user's folder of presets."""

from __future__ import annotations

from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bl_ui.utils import PresetPanel

from .attributes import CATEGORIES, SCALARS

SUBDIR = "primdiffusion/generate"
_ASKED = (*CATEGORIES, *(part for name in SCALARS for part in (f"use_{name}", name)))

NO_PRESET = "Generate Presets"
"""What the menu says before one is chosen; it shows the name of the one in use, as Blender's own do."""


class PRIMDIFFUSION_PT_generate_presets(PresetPanel, bpy.types.Panel):
    """Choose, add and remove presets"""

    bl_label = NO_PRESET
    preset_subdir = SUBDIR
    preset_operator = "primdiffusion.use_generate_preset"
    preset_add_operator = "primdiffusion.add_generate_preset"


class PRIMDIFFUSION_OT_add_generate_preset(AddPresetBase, bpy.types.Operator):
    """Keep quality, sampler, steps, attributes and guidance as a preset, or remove one"""

    bl_idname = "primdiffusion.add_generate_preset"
    bl_label = "Add Generate Preset"
    preset_menu = "PRIMDIFFUSION_PT_generate_presets"
    preset_subdir = SUBDIR
    preset_defines = ["settings = bpy.context.scene.primdiffusion"]  # noqa: RUF012
    preset_values = [  # noqa: RUF012
        "settings.steps",
        "settings.sampler",
        "settings.guidance",
        *(f"settings.attributes.{name}" for name in _ASKED),
    ]


class PRIMDIFFUSION_OT_use_generate_preset(bpy.types.Operator):
    """Take over the settings of this preset"""

    bl_idname = "primdiffusion.use_generate_preset"
    bl_label = "Use Generate Preset"
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """A checkpoint may not know what a preset asks for; what comes before it is then taken over."""
        path = Path(self.filepath)
        try:
            bpy.utils.execfile(str(path))
        except OSError as error:
            self.report({"ERROR"}, f"The preset cannot be read: {error}. Choose another one")
            return {"CANCELLED"}
        except (TypeError, AttributeError, SyntaxError) as error:
            name = bpy.path.display_name(path.name)
            self.report({"ERROR"}, f"The preset {name!r} does not suit this checkpoint or version: {error}. Remove it")
            return {"CANCELLED"}
        PRIMDIFFUSION_PT_generate_presets.bl_label = bpy.path.display_name(path.name)
        return {"FINISHED"}
