"""The sidebar panel Human: the selected human as a whole."""

from __future__ import annotations

import bpy

from ..backend.requests import sentence
from ..jobs.deferred_volumes import deferred_volumes
from ..jobs.target import selected_person
from ..scene.copies import duplicate_human
from ..scene.edit import leave_mode, select_human
from ..scene.human import armature_of, check_editable, humans, remove_human
from ..scene.place import stand_beside_others
from ..scene.volumes import free_unused_grids
from .drawing import SidebarPanel, draw_lines
from .on_person import OnPerson


class PRIMDIFFUSION_OT_select_human(OnPerson, bpy.types.Operator):
    """Make the armature of this human the active object, and the only one selected"""

    bl_idname = "primdiffusion.select_human"
    bl_label = "Select Human"
    bl_options = {"REGISTER", "UNDO"}

    frame: bpy.props.BoolProperty(name="Frame", description="Frame the human in the view, too", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return "Select this human and frame it in the view" if properties.frame else str(cls.__doc__)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """Frames in the viewport that the button was pressed in, else in the first one."""
        place = _viewport(context) if self.frame else None
        if self.frame and place is None:
            raise ValueError("no 3D viewport is open: open one")
        select_human(context, person)
        if place is not None:
            with context.temp_override(**place):
                bpy.ops.view3d.view_selected()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_duplicate_human(OnPerson, bpy.types.Operator):
    """Duplicate this human, with a separate armature and body"""

    bl_idname = "primdiffusion.duplicate_human"
    bl_label = "Duplicate Human"
    bl_options = {"REGISTER", "UNDO"}

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        check_editable(person)
        leave_mode(context)
        twin = duplicate_human(person)
        context.view_layer.update()
        stand_beside_others(context, twin)
        select_human(context, twin)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_delete_human(OnPerson, bpy.types.Operator):
    """Remove this human from the scene"""

    bl_idname = "primdiffusion.delete_human"
    bl_label = "Delete Human"
    bl_options = {"UNDO"}  # nothing to redo

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """Linked humans belong to another file: the Outliner unlinks them."""
        if person.library is not None:
            raise ValueError(f"the human {person.name!r} is linked: remove it in the Outliner with Unlink")
        leave_mode(context)
        remove_human(person)
        context.view_layer.update()  # evaluated data holds grids too
        free_unused_grids()
        return {"FINISHED"}


def _viewport(context: bpy.types.Context) -> dict[str, object] | None:
    windows = [context.window] if context.window else list(context.window_manager.windows)
    areas = [(window, area) for window in windows for area in window.screen.areas if area.type == "VIEW_3D"]
    for window, area in sorted(areas, key=lambda found: found[1] != context.area):
        region = next(region for region in area.regions if region.type == "WINDOW")
        return {"window": window, "area": area, "region": region}
    return None


class PRIMDIFFUSION_MT_people(bpy.types.Menu):
    """The humans of the scene"""

    bl_label = "Humans"

    def draw(self, context: bpy.types.Context) -> None:
        for person in humans(context.scene):
            choice = self.layout.operator("primdiffusion.select_human", text=person.name, icon="OUTLINER_OB_ARMATURE")
            choice.human = person.name


class PRIMDIFFUSION_PT_human(SidebarPanel, bpy.types.Panel):
    """Who is selected, by name."""

    bl_label = "Human"
    bl_order = 1
    manual_page = "editing"

    def draw(self, context: bpy.types.Context) -> None:
        if deferred_volumes.error:
            draw_lines(self.layout, deferred_volumes.error, "ERROR")
        row = self.layout.row(align=True)
        if humans(context.scene):
            row.menu("PRIMDIFFUSION_MT_people", text="", icon="OUTLINER_OB_ARMATURE")
        try:
            settings = armature_of(selected_person(context)).primdiffusion_human
        except ValueError as error:
            draw_lines(self.layout, sentence(error), "INFO")
            return
        row.prop(settings, "person", text="")
        row.operator("primdiffusion.select_human", text="", icon="RESTRICT_SELECT_OFF")
        row.operator("primdiffusion.select_human", text="", icon="ZOOM_SELECTED").frame = True
        row.operator("primdiffusion.duplicate_human", text="", icon="DUPLICATE")
        row.operator("primdiffusion.delete_human", text="", icon="TRASH")
