"""Human from Captures. Not redoable: moving a redo slider must not start an expensive job again."""

from __future__ import annotations

import bpy

from ..jobs.follow import submit


class PRIMDIFFUSION_OT_human_from_captures(bpy.types.Operator):
    """Make a person of pictures from several sides, and add it to the scene with an armature"""

    bl_idname = "primdiffusion.human_from_captures"
    bl_label = "Human from Captures"
    bl_options: set[str] = set()  # noqa: RUF012  neither REGISTER (redo) nor UNDO: the result has one

    directory: bpy.props.StringProperty(
        name="Captures", description="Empty: the panel's", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    subject: bpy.props.StringProperty(name="Subject", description="Empty: the panel's", options={"SKIP_SAVE"})
    frame: bpy.props.IntProperty(name="Frame", default=-1, min=-1, description="-1: the panel's", options={"SKIP_SAVE"})
    views: bpy.props.IntProperty(name="Views", default=0, min=0, description="0: the panel's", options={"SKIP_SAVE"})
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Where the panel names no folder, the file browser asks for one."""
        if self.directory or context.scene.primdiffusion_reconstruct.capture:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put it in line; in background mode this waits for the person."""
        from .reconstruct_work import ReconstructWork

        asked = context.scene.primdiffusion_reconstruct
        folder = bpy.path.abspath(self.directory or asked.capture)
        subject = self.subject or ("" if self.directory else asked.subject)  # the panel's is somebody of its folder
        if not folder:
            self.report({"ERROR"}, "choose the folder of captures first")
            return {"CANCELLED"}
        frame, views = self.frame if self.frame >= 0 else asked.frame, self.views or asked.views
        return submit(self, context, ReconstructWork(folder, subject, frame, views))
