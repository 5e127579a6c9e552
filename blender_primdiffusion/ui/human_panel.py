"""The sidebar panel Human: the selected person as a whole; what can be changed is in its sub-panels."""

from __future__ import annotations

import bpy

from ..jobs.target import selected_person
from ..scene.human import armature_of, humans, remove_human
from ..worker.sentence import sentence
from .drawing import SidebarPanel, draw_lines
from .files_panel import draw_missing
from .manual import draw_manual_button
from .on_person import OnPerson


class PRIMDIFFUSION_OT_select_human(OnPerson, bpy.types.Operator):
    """Make the armature of this person the active object, and the only one selected"""

    bl_idname = "primdiffusion.select_human"
    bl_label = "Select Human"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        select(context, person)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_frame_human(OnPerson, bpy.types.Operator):
    """Select this person and move the view so that they fill it"""

    bl_idname = "primdiffusion.frame_human"
    bl_label = "Frame Human"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """In the 3D viewport that this was pressed in, else in the first."""
        place = _viewport(context)
        if place is None:
            raise ValueError("no 3D viewport is open: open one")
        select(context, person)
        with context.temp_override(**place):
            bpy.ops.view3d.view_selected()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_duplicate_human(OnPerson, bpy.types.Operator):
    """Duplicate this person, with an armature and body of their own and the same files"""

    bl_idname = "primdiffusion.duplicate_human"
    bl_label = "Duplicate Human"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """The new person is selected."""
        from ..scene.build import stand_beside_others
        from ..scene.duplicate import duplicate_human
        from ..scene.human import check_editable
        from ..scene.painting import leave_mode

        check_editable(person)
        leave_mode(context)
        twin = duplicate_human(person)
        context.view_layer.update()
        stand_beside_others(context, twin)
        select(context, twin)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_delete_human(OnPerson, bpy.types.Operator):
    """Remove this person from the scene; their files stay on disk for Undo, until Remove Unused Files"""

    bl_idname = "primdiffusion.delete_human"
    bl_label = "Delete Human"
    bl_options = {"UNDO"}  # noqa: RUF012  nothing to redo

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        try:
            title = f"Delete {self.person(context).name}?"
        except ValueError:
            return self.execute(context)
        message = "Their files stay on disk for Undo: Files > Remove Unused Files deletes them"
        return context.window_manager.invoke_confirm(self, event, title=title, message=message)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """Linked people are unlinked by the Outliner, not here: they belong to another file."""
        from ..scene.grid_cache import free_unused_grids
        from ..scene.painting import leave_mode

        if person.library is not None:
            raise ValueError(f"the person {person.name!r} is linked: remove them in the Outliner with Unlink")
        leave_mode(context)
        remove_human(person)
        context.view_layer.update()  # what is evaluated holds grids too
        free_unused_grids()
        return {"FINISHED"}


def select(context: bpy.types.Context, person: bpy.types.Collection) -> None:
    """Make a person's armature active. Raises ValueError for one that cannot be selected in this view layer."""
    from ..scene.painting import leave_mode

    armature = armature_of(person)
    if context.view_layer.objects.get(armature.name) != armature:
        raise ValueError(f"the armature of {person.name!r} is not in this view layer: enable their collection first")
    leave_mode(context)
    for obj in context.view_layer.objects.selected:
        obj.select_set(False)
    armature.select_set(True)
    context.view_layer.objects.active = armature


def _viewport(context: bpy.types.Context) -> dict[str, object] | None:
    windows = [context.window] if context.window else list(context.window_manager.windows)
    areas = [(window, area) for window in windows for area in window.screen.areas if area.type == "VIEW_3D"]
    for window, area in sorted(areas, key=lambda found: found[1] != context.area):
        region = next(region for region in area.regions if region.type == "WINDOW")
        return {"window": window, "area": area, "region": region}
    return None


class PRIMDIFFUSION_MT_people(bpy.types.Menu):
    """The people of the scene"""

    bl_label = "People"

    def draw(self, context: bpy.types.Context) -> None:
        """Choosing one selects them."""
        for person in humans(context.scene):
            choice = self.layout.operator("primdiffusion.select_human", text=person.name, icon="OUTLINER_OB_ARMATURE")
            choice.human = person.name


class PRIMDIFFUSION_PT_human(SidebarPanel, bpy.types.Panel):
    """Who is selected, by name."""

    bl_label = "Human"
    bl_order = 2

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual's page."""
        draw_manual_button(self.layout, "editing")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        draw_missing(self.layout)
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
        row.operator("primdiffusion.frame_human", text="", icon="ZOOM_SELECTED")
        row.operator("primdiffusion.duplicate_human", text="", icon="DUPLICATE")
        row.operator("primdiffusion.delete_human", text="", icon="TRASH")


CLASSES = (
    PRIMDIFFUSION_OT_select_human,
    PRIMDIFFUSION_OT_frame_human,
    PRIMDIFFUSION_OT_duplicate_human,
    PRIMDIFFUSION_OT_delete_human,
    PRIMDIFFUSION_MT_people,
    PRIMDIFFUSION_PT_human,
)
