"""Set up, cancel, repair, remove and test the backend. None touches the scene."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...places import CACHE_VARIABLE, backend_module_path, cache_folder, preference, set_up_folder
from ...worker.sentence import sentence
from . import known
from .session import redraw, see_through, session

if TYPE_CHECKING:
    from ...worker.setup import Steps

OWN_LOCK = "requirements.txt"
"""In a folder of wheels: a list of packages that goes before ours."""


def installing(wheels: Path | None = None) -> Steps:
    """From the package index, or from a folder of wheels, whose own list of packages goes before ours.

    Raises ValueError where there are no packages for this machine or Blender may not use the network, and OSError.
    """
    from ...worker import setup

    compute, lock, _ = known.chosen()
    if wheels is None and not bpy.app.online_access:
        raise ValueError(setup.OFFLINE)
    if wheels is not None and (wheels / OWN_LOCK).is_file():
        lock = known.read_once(wheels / OWN_LOCK)
    return setup.set_up(set_up_folder(), lock, compute, _module_path(), cache_folder(), wheels)


def removing() -> Steps:
    """Also where there are no packages for this machine any more. A cache that is shared with others stays."""
    from ...worker import setup

    return setup.remove(set_up_folder(), None if os.environ.get(CACHE_VARIABLE) else cache_folder())


def testing() -> Steps:
    """On the Python that would run the backend."""
    from ...worker import environment, setup

    named = preference("backend_python")
    own = None if known.known().state == "own Python" else set_up_folder().environment
    _, python = next(environment.candidates(named, own))
    return setup.self_test(set_up_folder(), python, _module_path(), cache_folder())


def _module_path() -> Path:
    path = backend_module_path()
    if path is None:
        raise ValueError("the extension lacks its backend: install its zip again")
    return path


def _begin(operator: bpy.types.Operator, make: Callable[[], Steps], *, replaces: bool = True) -> set[str]:
    """Start and follow; a sentence where that cannot be. `replaces`: the environment, which children run on."""
    try:
        if session.busy:
            raise ValueError("The backend is being set up already; wait for it, or press Cancel")
        steps = make()
        if replaces:
            _release_environment()
        session.start(steps)
    except (ValueError, OSError) as error:
        operator.report({"ERROR"}, sentence(error))
        return {"CANCELLED"}
    return see_through(operator)


def _release_environment() -> None:
    """End the children that run on the environment: their files could not be replaced. Raises ValueError."""
    from ...engine import studio
    from ...jobs.queue import queue

    if queue.busy:
        raise ValueError("The backend is at work; wait until it is done, or press Cancel")
    queue.close()
    studio.close()


class PRIMDIFFUSION_OT_set_up_backend(bpy.types.Operator):
    """Download the backend's packages into a private environment and test it"""

    bl_idname = "primdiffusion.set_up_backend"
    bl_label = "Set Up Backend"
    bl_options: set[str] = set()  # noqa: RUF012  bpy wants a plain set

    def execute(self, context: bpy.types.Context) -> set[str]:
        """With a window a timer follows; in background mode this waits."""
        now = known.known()
        try:
            there = now.state == "ready" and now.about.get("compute") == known.chosen()[0]
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        if there:
            self.report({"INFO"}, f"{now.line}; press Repair to install it anew")
            return {"FINISHED"}
        return _begin(self, installing)


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
        return _begin(self, lambda: installing(folder))


class PRIMDIFFUSION_OT_cancel_set_up(bpy.types.Operator):
    """Stop; what has been downloaded is used by the next Set Up Backend"""

    bl_idname = "primdiffusion.cancel_set_up"
    bl_label = "Cancel"
    bl_options: set[str] = set()  # noqa: RUF012

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """While something is under way."""
        cls.poll_message_set("Nothing is being set up")
        return session.busy

    def execute(self, context: bpy.types.Context) -> set[str]:
        """End the process at work."""
        session.cancel()
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_repair_backend(bpy.types.Operator):
    """Set up the backend anew in the place of the one that is there"""

    bl_idname = "primdiffusion.repair_backend"
    bl_label = "Repair"
    bl_options: set[str] = set()  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """As Set Up Backend."""
        return _begin(self, installing)


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
        if not any(path.exists() for path in (set_up_folder().environment, set_up_folder().pip_cache)):
            self.report({"ERROR"}, "There is no backend to remove: none was set up here")
            return {"CANCELLED"}
        return _begin(self, removing)


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
        return _begin(self, testing, replaces=False)
