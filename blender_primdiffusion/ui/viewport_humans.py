"""Humans in 3D views that do not render: the switch among the overlays, and clicks that select them."""

from __future__ import annotations

import bpy

from ..engine import shows_humans
from ..engine.gpu.overlay import overlay
from ..scene.human import any_humans

_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []
_CLICKS = (("Object Mode", "EMPTY", "CLICK"), ("3D View Tool: Tweak", "VIEW_3D", "PRESS"))
"""Keymap, its space and the event: Blender selects at a click, with the tool Tweak when the button goes down."""


class PRIMDIFFUSION_OT_click_human(bpy.types.Operator):
    """Select the human under the mouse, where a 3D view shows it without volumes"""

    bl_idname = "primdiffusion.click_human"
    bl_label = "Select Human"
    bl_options = {"REGISTER", "UNDO"}

    extend: bpy.props.BoolProperty(
        name="Extend", description="Keep what is selected; a selected human is deselected", options={"SKIP_SAVE"}
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Leave the click to Blender where no human is, or another object in front; a press may begin a drag."""
        if context.mode != "OBJECT" or context.region_data is None or not shows_humans(context):
            return {"PASS_THROUGH"}
        obj = overlay.object_at(context, event.mouse_region_x, event.mouse_region_y)
        if obj is None or obj.hide_select:
            return {"PASS_THROUGH"}
        selected = obj.select_get()
        if not self.extend:
            for other in context.selected_objects:
                other.select_set(False)
        if self.extend and selected and context.view_layer.objects.active == obj:
            obj.select_set(False)
        else:
            obj.select_set(True)
            context.view_layer.objects.active = obj
        if event.value != "PRESS":
            return {"FINISHED"}
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL", "PASS_THROUGH"}

    def modal(self, _context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Wait for the release of the button, or leave a drag to Blender, which moves what is selected.

        After a press with both results of `invoke` Blender calls no other operator (its own would deselect everything)
        but still reports a drag. The release is consumed: Blender would deselect at a click, too.
        """
        if event.value == "CLICK_DRAG":
            return {"FINISHED", "PASS_THROUGH"}
        return {"FINISHED"} if event.type == "LEFTMOUSE" else {"PASS_THROUGH"}


def draw_switch(menu: bpy.types.Panel, context: bpy.types.Context) -> None:
    """In the popover Viewport Overlays."""
    if any_humans():
        column = menu.layout.column()
        column.label(text="PrimDiffusion", translate=False)
        column.prop(context.scene.primdiffusion_render, "in_viewports")


def register() -> None:
    """Add the switch and, where Blender has a window, the clicks."""
    bpy.types.VIEW3D_PT_overlay.append(draw_switch)
    keys = bpy.context.window_manager.keyconfigs.addon
    for name, space, event in _CLICKS if keys is not None else ():
        keymap = keys.keymaps.new(name, space_type=space)
        for extend in (False, True):
            item = keymap.keymap_items.new("primdiffusion.click_human", "LEFTMOUSE", event, shift=extend, head=True)
            item.properties.extend = extend
            _keys.append((keymap, item))


def unregister() -> None:
    """Undo `register`."""
    bpy.types.VIEW3D_PT_overlay.remove(draw_switch)
    while _keys:
        keymap, item = _keys.pop()
        keymap.keymap_items.remove(item)
