"""Find, restore, collect and remove files of people."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..jobs.follow import submit
from ..jobs.missing_files import look, state
from ..jobs.target import Target
from .drawing import draw_job, draw_lines
from .on_person import OnPerson


class _Find:
    """What both ways of looking have in common."""

    bl_options: set[str] = set()  # noqa: RUF012  neither REGISTER nor UNDO: each result makes its own step

    directory: bpy.props.StringProperty(
        name="Folder",
        description="Where to look too, and in the folders inside. Empty: beside this file, where it was last saved "
        "and in the folders of other people",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put paths right; have the child write again what is nowhere."""
        from ..scene.missing import copy_back, find_files, missing_files, repair

        directory = Path(bpy.path.abspath(self.directory)) if self.directory else None
        try:
            lost = missing_files()
            found = find_files(lost, directory)
            repaired = repair(lost, found)
            brought = copy_back(lost, found, directory)
            if repaired:
                bpy.ops.ed.undo_push(message="Find Missing Volumes")
            restored, left = self._restore(context, directory)
        except OSError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            look()
        if left:
            done = repaired or brought or restored
            self.report({"WARNING" if done else "ERROR"}, "; ".join(left))
            return {"FINISHED"} if done else {"CANCELLED"}
        news = f"{repaired + brought} files found" if lost else "No files of people are missing"
        self.report({"INFO"}, news)
        return {"FINISHED"}

    def _restore(self, context: bpy.types.Context, directory: Path | None) -> tuple[int, list[str]]:
        """Works put in line for people whose files are nowhere, and sentences on those who cannot be helped."""
        from ..jobs.restore import RestoreJob
        from ..scene.missing import find_person, missing_files

        jobs, left = [], []
        for one in missing_files():
            source = find_person(one, directory)
            if one.linked:
                left.append(
                    f"{one.summary()}, linked from {one.linked!r}, cannot be found: open that file and search there"
                )
            elif source is None:
                left.append(
                    f"{one.summary()} cannot be found: put them back, choose the folder that they are in, or press "
                    "Generate Again where a seed made them"
                )
            elif one.merged and not (one.volumes or one.person_file or one.body_file):
                left.append(f"{one.summary()} cannot be found: press Merge again")
            else:
                try:
                    jobs.append(RestoreJob(Target.of(one.person), str(source)))
                except ValueError as error:
                    left.append(str(error))
        done = [job for job in jobs if submit(self, context, job) == {"FINISHED"}]
        return len(done), left


class PRIMDIFFUSION_OT_find_missing_volumes(_Find, bpy.types.Operator):
    """Find missing files of people, and restore those that cannot be found"""

    bl_idname = "primdiffusion.find_missing_volumes"
    bl_label = "Find Missing Volumes"


class PRIMDIFFUSION_OT_find_volumes_in_folder(_Find, bpy.types.Operator):
    """Choose a folder to search for missing files of people"""

    bl_idname = "primdiffusion.find_volumes_in_folder"
    bl_label = "Find Volumes in Folder"

    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """The file browser, for a folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


class PRIMDIFFUSION_OT_generate_again(OnPerson, bpy.types.Operator):
    """Generate this person again from their seed, when all of their files are lost"""

    bl_idname = "primdiffusion.generate_again"
    bl_label = "Generate Again"
    bl_options: set[str] = set()  # noqa: RUF012  neither REGISTER (redo) nor UNDO (the result has one)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.restore import RegenerateJob, made_from_seed
        from ..scene.files import person_file

        try:
            there = person_file(person)
        except FileNotFoundError:
            return submit(self, context, RegenerateJob(Target.of(person), made_from_seed(person)))
        raise ValueError(f"the file of {person.name!r} is there, {there.name!r}: press Find Missing Volumes")


class PRIMDIFFUSION_OT_collect_files(bpy.types.Operator):
    """Copy the files of all people next to this .blend, so that it can be moved or sent with one folder"""

    bl_idname = "primdiffusion.collect_files"
    bl_label = "Collect Files"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Tell what was copied."""
        from ..scene.collect import collect_files
        from ..scene.files import humans_folder

        try:
            done = collect_files()
        except (OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        look()
        where = humans_folder().name
        if done.volumes:
            size = f"{done.files} files, {done.size / 1e6:.1f} MB"
            self.report({"INFO"}, f"{done.volumes} volumes are in {where!r} now ({size} copied); save this file")
        else:
            self.report({"INFO"}, f"All files of people are in {where!r} already")
        return {"FINISHED"}


class PRIMDIFFUSION_OT_remove_unused_files(bpy.types.Operator):
    """Delete files in the folder of people beside this file that nobody shows now. Undo of edits, and other .blend \
files that share the folder, will miss them"""

    bl_idname = "primdiffusion.remove_unused_files"
    bl_label = "Remove Unused Files"
    bl_options: set[str] = set()  # noqa: RUF012  files cannot be undone

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Delete them and say how many and how large they were."""
        from ..scene.collect import unused
        from ..scene.files import humans_folder

        removed = size = 0
        for path in unused(humans_folder()):
            try:
                size += path.stat().st_size
                path.unlink()
                removed += 1
            except OSError as error:
                self.report({"WARNING"}, f"{str(path)!r} could not be removed ({error})")
        self.report({"INFO"}, f"Removed {removed} files ({size / 1e6:.1f} MB) from {str(humans_folder())!r}")
        return {"FINISHED"}


def draw_missing(layout: bpy.types.UILayout) -> None:
    """What is missing and what can be done; nothing when everybody is whole."""
    if not state.told:
        return
    box = layout.box()
    draw_lines(box, f"Missing: {state.told}", "ERROR")
    row = box.row(align=True)
    draw_job(row.column(), "restore_volumes", "primdiffusion.find_missing_volumes", "VIEWZOOM")
    row.operator("primdiffusion.find_volumes_in_folder", text="", icon="FILE_FOLDER")
    for name in state.without_person_file:
        draw_job(box, "regenerate", "primdiffusion.generate_again", "FILE_REFRESH").human = name


CLASSES = (
    PRIMDIFFUSION_OT_find_missing_volumes,
    PRIMDIFFUSION_OT_find_volumes_in_folder,
    PRIMDIFFUSION_OT_generate_again,
    PRIMDIFFUSION_OT_collect_files,
    PRIMDIFFUSION_OT_remove_unused_files,
)
