"""Set up, cancel, repair, remove and try the backend. None touches the scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...places import set_up_folder
from ...worker.sentence import sentence
from . import known
from .session import redraw, see_through, session

if TYPE_CHECKING:
    from ...worker.setup_job import Kind
    from ...worker.setup_steps import Plan


def _begin(operator: bpy.types.Operator, kind: Kind, make_plan: Callable[[], Plan]) -> set[str]:
    """Start and follow; a sentence where that cannot be."""
    try:
        plan = make_plan()
        if kind != "self_test":
            _release_environment()
        session.start(kind, plan)
    except (ValueError, OSError) as error:
        operator.report({"ERROR"}, sentence(error))
        return {"CANCELLED"}
    return see_through(operator)


def _release_environment() -> None:
    """End the children that run on the environment: their files could not be replaced. Raises ValueError."""
    from ...engine import studio
    from ..jobs.queue import queue

    if session.busy:
        raise ValueError("The backend is being set up already; wait for it, or press Cancel")
    if queue.busy:
        raise ValueError("The backend is at work; wait until it is done, or press Cancel")
    queue.close()
    studio.close()


class PRIMDIFFUSION_OT_set_up_backend(bpy.types.Operator):
    """Download the backend's packages into a private environment and try it; what was begun before goes on"""

    bl_idname = "primdiffusion.set_up_backend"
    bl_label = "Set Up Backend"
    bl_options: set[str] = set()  # noqa: RUF012  bpy wants a plain set

    def execute(self, context: bpy.types.Context) -> set[str]:
        """With a window a timer follows; in background mode this waits."""
        from ...worker.setup_steps import OFFLINE

        try:
            compute = known.chosen()[0]
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        now = known.known()
        if now.state == "ready" and now.about.get("compute") == compute:
            self.report({"INFO"}, f"{now.line}; press Repair to check it")
            return {"FINISHED"}
        if not bpy.app.online_access:
            self.report({"ERROR"}, OFFLINE)
            return {"CANCELLED"}
        from .plans import plan_of_set_up

        return _begin(self, "set_up", plan_of_set_up)


class PRIMDIFFUSION_OT_install_from_folder(bpy.types.Operator):
    """Set up the backend from a folder of wheels, without a network; every file is checked against its known hash"""

    bl_idname = "primdiffusion.install_from_folder"
    bl_label = "Install from Folder"
    bl_options: set[str] = set()  # noqa: RUF012

    directory: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """As Set Up Backend."""
        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        if folder is None or not folder.is_dir():
            self.report({"ERROR"}, f"{self.directory!r} is no folder: choose the one that holds the wheels")
            return {"CANCELLED"}
        from .plans import plan_of_set_up

        return _begin(self, "set_up", lambda: plan_of_set_up(folder))


class PRIMDIFFUSION_OT_cancel_set_up(bpy.types.Operator):
    """Stop; what has been downloaded is kept, and Set Up Backend goes on from there"""

    bl_idname = "primdiffusion.cancel_set_up"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """While something is under way."""
        cls.poll_message_set("Nothing is being set up")
        return session.busy

    def execute(self, context: bpy.types.Context) -> set[str]:
        """End the process with all it has started."""
        session.cancel()
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_repair_backend(bpy.types.Operator):
    """Compare every installed file with its record, and set up anew where one differs or something is missing"""

    bl_idname = "primdiffusion.repair_backend"
    bl_label = "Repair"
    bl_options: set[str] = set()  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """As Set Up Backend."""
        from .plans import plan_of_set_up

        return _begin(self, "repair", plan_of_set_up)


class PRIMDIFFUSION_OT_remove_backend(bpy.types.Operator):
    """Delete the private environment and the caches; people in your files stay as they are"""

    bl_idname = "primdiffusion.remove_backend"
    bl_label = "Remove"
    bl_options: set[str] = set()  # noqa: RUF012

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        size = known.known().about.get("bytes", 0)
        freed = f" and {known.gigabytes(size)} on disk are free again" if size else ""
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Remove the Backend?",
            message=f"Environment and caches are deleted{freed}",
            confirm_text="Remove",
            icon="WARNING",
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Without asking when called from Python."""
        if not any(path.exists() for path in (set_up_folder().environment, set_up_folder().wheels)):
            self.report({"ERROR"}, "There is no backend to remove: none was set up here")
            return {"CANCELLED"}
        from .plans import plan_of_removal

        return _begin(self, "remove", plan_of_removal)


class PRIMDIFFUSION_OT_test_backend(bpy.types.Operator):
    """Start the backend that is named or set up, and generate a person in a few steps"""

    bl_idname = "primdiffusion.test_backend"
    bl_label = "Test"
    bl_options: set[str] = set()  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """With a window a timer follows; in background mode this waits."""
        now = known.known()
        if not now.usable:
            self.report({"ERROR"}, f"{now.line}: press Set Up Backend first, or name a Python")
            return {"CANCELLED"}
        from .plans import plan_of_test

        return _begin(self, "self_test", plan_of_test)
