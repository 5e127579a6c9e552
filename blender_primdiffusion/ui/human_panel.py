"""The sidebar panel Human: the selected human as a whole; operators on the files of humans."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..backend.requests import error_text, sentence
from ..formats.regular_files import FileError, remove_file
from ..formats.whole_files import remove_empty
from ..jobs.deferred_volumes import deferred_volumes, keep_writing
from ..jobs.edit import RegenerateJob, made_from_seed
from ..jobs.follow import Reporting, submit
from ..jobs.missing_files import look, state
from ..jobs.target import HumanTarget, selected_person
from ..scene.collect import collect_files, ignored_values, unused
from ..scene.copies import duplicate_human
from ..scene.edit import leave_mode, select_human
from ..scene.human import armature_of, check_editable, humans, humans_folder, note_state, person_file, remove_human
from ..scene.missing import MissingFiles, missing_files, repair
from ..scene.place import stand_beside_others
from ..scene.volumes import free_unused_grids
from .drawing import SidebarPanel, draw_job, draw_lines
from .on_person import OnPerson


class PRIMDIFFUSION_OT_find_missing_volumes(bpy.types.Operator):
    """Find missing files of humans: their volumes are written again from them"""

    bl_idname = "primdiffusion.find_missing_volumes"
    bl_label = "Find Missing Volumes"
    bl_options: set[str] = set()  # neither REGISTER nor UNDO: each result makes its own step

    directory: bpy.props.StringProperty(
        name="Folder",
        description="Where to look too, and in the folders inside. Empty: beside this file, where it was last saved "
        "and in the folders of other humans",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    choose: bpy.props.BoolProperty(
        name="Choose Folder", description="Choose the folder in the file browser", options={"SKIP_SAVE"}
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return "Choose a folder to search for missing files of humans" if properties.choose else str(cls.__doc__)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self.choose:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        for fault in ignored_values():
            self.report({"WARNING"}, sentence(fault))
        directory = Path(bpy.path.abspath(self.directory)) if self.directory else None
        try:
            lost = missing_files()
            repaired = repair(lost, directory)
            if repaired:
                bpy.ops.ed.undo_push(message="Find Missing Volumes")
            if bpy.app.background:
                deferred_volumes.finish()
            keep_writing()
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        finally:
            look()
        left = [_cannot_be_found(one) for one in missing_files()]
        if left:
            self.report({"WARNING" if repaired else "ERROR"}, "; ".join(left))
            return {"FINISHED"} if repaired else {"CANCELLED"}
        self.report({"INFO"}, "All files of humans are found" if lost else "No files of humans are missing")
        return {"FINISHED"}


def _cannot_be_found(one: MissingFiles) -> str:
    if one.linked:
        return f"{one.summary()}, linked from {one.linked!r}, cannot be found: open that file and search there"
    if not one.file:
        return f"{one.summary()} cannot be found: press Merge again"
    return (
        f"{one.summary()} cannot be found: put it back, choose the folder that it is in, or press Generate Again where "
        "a seed made the human"
    )


class PRIMDIFFUSION_OT_generate_again(OnPerson, bpy.types.Operator):
    """Generate this human again from its seed, when all of its files are lost"""

    bl_idname = "primdiffusion.generate_again"
    bl_label = "Generate Again"

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        try:
            there = person_file(person)
        except FileNotFoundError:
            return submit(self, context, RegenerateJob(HumanTarget.of(person), made_from_seed(person)))
        raise ValueError(f"the file of {person.name!r} is there, {there.name!r}: press Find Missing Volumes")


class PRIMDIFFUSION_OT_collect_files(Reporting, bpy.types.Operator):
    """Copy the files of all humans next to this .blend, so that it can be moved or sent with one folder"""

    bl_idname = "primdiffusion.collect_files"
    bl_label = "Collect Files"
    bl_options = {"UNDO"}

    def act(self, _context: bpy.types.Context) -> set[str]:
        done = collect_files()
        for fault in ignored_values():
            self.report({"WARNING"}, sentence(fault))
        look()
        where = humans_folder().name
        if done.humans or done.files:
            size = f"{done.files} files, {done.size / 1e6:.1f} MB"
            self.report({"INFO"}, f"The files of {done.humans} humans are in {where!r} now ({size}); save this file")
        else:
            self.report({"INFO"}, f"All files of humans are in {where!r} already")
        return {"FINISHED"}


class PRIMDIFFUSION_OT_remove_unused_files(bpy.types.Operator):
    """Delete files in the folder beside this .blend that it does not use. Undo of edits, and other .blend \
files that share the folder, may need them"""

    bl_idname = "primdiffusion.remove_unused_files"
    bl_label = "Remove Unused Files"
    bl_options: set[str] = set()  # files cannot be undone

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        removed = size = 0
        folders = set()
        for path in unused(humans_folder()):
            try:
                size += path.stat().st_size
                remove_file(path, humans_folder())
                removed += 1
                folders.add(path.parent)
                note_state(path.parent)
            except (OSError, FileError) as error:
                self.report({"WARNING"}, f"{str(path)!r} could not be removed ({error!s:.160})")
        remove_empty([*folders, *({folder.parent for folder in folders} - {humans_folder(), humans_folder().parent})])
        self.report({"INFO"}, f"Removed {removed} files ({size / 1e6:.1f} MB) from {str(humans_folder())!r}")
        return {"FINISHED"}


def draw_missing(layout: bpy.types.UILayout) -> None:
    """What is missing and what can be done about it; nothing when all files are there."""
    if deferred_volumes.error:
        draw_lines(layout, deferred_volumes.error, "ERROR")
    if deferred_volumes.notice:
        draw_lines(layout, deferred_volumes.notice, "INFO")
    if not state.summary:
        return
    box = layout.box()
    draw_lines(box, f"Missing: {state.summary}", "ERROR")
    row = box.row(align=True)
    row.operator("primdiffusion.find_missing_volumes", icon="VIEWZOOM")
    row.operator("primdiffusion.find_missing_volumes", text="", icon="FILE_FOLDER").choose = True
    for name in state.without_person_file:
        draw_job(box, "regenerate", "primdiffusion.generate_again", "FILE_REFRESH").human = name


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
    """Duplicate this human, with a separate armature and body but the same files"""

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
    """Remove this human from the scene; its files stay on disk for Undo, until Remove Unused Files"""

    bl_idname = "primdiffusion.delete_human"
    bl_label = "Delete Human"
    bl_options = {"UNDO"}  # nothing to redo

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            title = f"Delete {self.person(context).name}?"
        except ValueError:
            return self.execute(context)
        message = "The files stay on disk for Undo: Advanced > Files > Remove Unused Files deletes them"
        return context.window_manager.invoke_confirm(self, event, title=title, message=message)

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
        row.operator("primdiffusion.select_human", text="", icon="ZOOM_SELECTED").frame = True
        row.operator("primdiffusion.duplicate_human", text="", icon="DUPLICATE")
        row.operator("primdiffusion.delete_human", text="", icon="TRASH")
