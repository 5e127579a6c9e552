"""What a Blender without the extension shows of a human: its body mesh, and a name that says what is missing.

Whether viewports hide this object is driven by a property that the extension registers on scenes. Where it is not
registered, the driver has its fallback value. So nothing is switched when files are saved and loaded, and no script
runs. Needs no numpy.
"""

from __future__ import annotations

import bpy

STAND_IN = "primdiffusion_stand_in"
"""Custom property of such an object."""
PRESENT = "primdiffusion_present"
"""Property of scenes while the extension is enabled; its value is never set."""
_LABEL = "needs_PrimDiffusion"

PROPERTIES = (
    (
        bpy.types.Scene,
        PRESENT,
        bpy.props.BoolProperty(
            name="PrimDiffusion", description="The extension is enabled", default=True, options={"HIDDEN"}
        ),
    ),
)


def build_stand_in(label: str, armature: bpy.types.Object, body: bpy.types.Object) -> bpy.types.Object:
    """The object, linked to no collection: the mesh of `body` on the armature, never rendered."""
    made = bpy.data.objects.new(f"{label}_{_LABEL}", body.data)
    made[STAND_IN] = True
    made.parent = armature
    modifier = made.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    modifier.use_deform_preserve_volume = False
    made.show_name = True
    made.hide_viewport = made.hide_render = True
    driver = made.driver_add("hide_viewport").driver
    driver.type = "SUM"
    variable = driver.variables.new()
    variable.type = "CONTEXT_PROP"
    (target,) = variable.targets
    target.context_property = "ACTIVE_SCENE"
    target.data_path = PRESENT
    target.use_fallback_value = True
    target.fallback_value = 0.0
    return made


def register() -> None:
    """Hide what stands in for humans of the open file, when the extension is enabled."""
    _evaluate()


def unregister() -> None:
    """Show it again."""
    _evaluate()


def _evaluate() -> None:
    for obj in getattr(bpy.data, "objects", ()):  # not while Blender starts
        if STAND_IN in obj:
            obj.update_tag()
