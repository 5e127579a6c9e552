"""Remove Unused Files: what earlier states of edited people have left on disk.

Edits leave the files of the states before them, which undo needs. Nothing can tell when they have become useless (undo
steps, backups and other .blend files beside this one may point to them), so only the user removes them.
"""

from __future__ import annotations

import bpy


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
        from ...scene.collect import unused
        from ...scene.files import humans_folder

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
