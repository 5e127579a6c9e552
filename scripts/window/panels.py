"""The sidebar: all panels as they open, or some panels alone, opened."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import bpy
from mathutils import Euler, Vector

_FIRST_TAB = "PrimDiffusion"
_shown: set[str] | None = None
"""Panels to show; None: all."""
_sections: set[str] = set()
"""Sections of these panels to open."""
_calls = 0


def view() -> tuple[bpy.types.Window, bpy.types.Area]:
    """The window and its 3D view."""
    window = bpy.context.window_manager.windows[0]
    return window, next(area for area in window.screen.areas if area.type == "VIEW_3D")


def sidebar(tab: str = _FIRST_TAB) -> Iterator[float]:
    """Show a tab of the extension."""
    _, area = view()
    area.spaces.active.show_region_ui = True
    yield 1.0
    _, area = view()
    region = next(region for region in area.regions if region.type == "UI")
    region.active_panel_category = tab
    yield 0.5


def show(*names: str | None) -> Iterator[float]:
    """Show only these panels, opened, in the tab of the first one; with None, all of the first tab. Of panels with
    sections, "advanced/merge" opens the section `merge` too.

    Blender has no function to open and close panels. So the panels are registered again, open by default, and `poll` of
    the others returns False. Which sections are open Blender remembers by their names, so each call gives them others.
    """
    global _shown, _calls
    wanted = [name.partition("/") for name in names if name]
    _shown = None if names == (None,) else {panel for panel, _, _ in wanted}
    _sections.clear()
    _sections.update(section for _, _, section in wanted if section)
    _calls += 1
    opened = bpy.types.PRIMDIFFUSION_PT_generate.__dict__.get("window_scenes")
    if not opened:
        _open_all()
    yield from sidebar(getattr(bpy.types, wanted[0][0]).bl_category if wanted else _FIRST_TAB)


def _open_all() -> None:
    classes = [cls for cls in bpy.types.Panel.__subclasses__() if _is_ours(cls)]
    classes.sort(key=lambda cls: bool(getattr(cls, "bl_parent_id", "")))
    for cls in reversed(classes):
        bpy.utils.unregister_class(cls)
    for cls in classes:
        cls.bl_idname = getattr(cls, "bl_idname", cls.__name__)
        cls.bl_options = {*getattr(cls, "bl_options", ())} - {"DEFAULT_CLOSED"}
        cls.poll = _polled(cls, getattr(cls, "poll", None))
        cls.window_scenes = True
        bpy.utils.register_class(cls)
    ui = bpy.types.PRIMDIFFUSION_PT_generate.__module__.rpartition(".")[0]
    draw_section = sys.modules[f"{ui}.drawing"].draw_section
    for name, module in list(sys.modules.items()):
        if name.startswith(f"{ui}.") and hasattr(module, "draw_section"):
            module.draw_section = lambda layout, *args, **given: draw_section(_Opening(layout), *args, **given)


class _Opening:
    """A layout for `draw_section`."""

    def __init__(self, layout: bpy.types.UILayout):
        self._layout = layout

    def panel(self, idname: str, *, default_closed: bool) -> tuple[bpy.types.UILayout, bpy.types.UILayout | None]:
        closed = default_closed and idname.removeprefix("primdiffusion_") not in _sections
        return self._layout.panel(f"{idname}_{_calls}", default_closed=closed)


def _polled(cls: type, before) -> classmethod:
    def poll(_cls, context: bpy.types.Context) -> bool:
        if _shown is not None and _cls.bl_idname not in _shown:
            return False
        return before is None or before(context)

    return classmethod(poll)


def _is_ours(cls: type) -> bool:
    return cls.__name__.startswith("PRIMDIFFUSION_PT_") and hasattr(cls, "bl_category") and cls.is_registered


def wide_view() -> None:
    """The 3D view rendered, from the front, at people's height, without a grid."""
    _, area = view()
    space = area.spaces.active
    space.shading.type = "RENDERED"
    space.overlay.show_overlays = True
    space.overlay.show_bones = False
    region = space.region_3d
    region.view_perspective = "PERSP"
    first = next((obj for obj in bpy.context.scene.objects if obj.type == "ARMATURE"), None)
    region.view_location = Vector((0.25, first.location.y if first else 0.0, 0.85))
    region.view_rotation = Euler((1.5, 0.0, 0.35)).to_quaternion()
    region.view_distance = 3.6
    space.overlay.show_floor = True
