"""Set up, cancel, repair, remove and test the backend, one at a time. The scene stays as it is."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import bpy

from ...backend import environment, setup
from ...backend.packages import read_lock
from ...backend.requests import sentence
from ...backend.setup import Steps
from ...engine import drawing_child
from ...jobs.queue import queue
from ...places import CACHE_VARIABLE, backend_module_path, cache_folder, preference, set_up_folder
from ..declared import SKIP
from ..preferences import NOTHING_TO_CANCEL
from . import known

TICK_S = 0.2
_PRINT_S = 2.0
"""Between lines of progress on the console in background mode."""


class SetUpSession:
    """Runs the steps of a set-up, a repair, a test or a removal. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.message = ""
        self.fraction = 0.0
        self.error = ""
        """Why the last one failed, in a sentence."""
        self.notice = ""
        """How the last one ended otherwise."""
        self._steps: Steps | None = None

    @property
    def busy(self) -> bool:
        """Something is being set up, repaired, tested or removed."""
        return self._steps is not None

    def start(self, steps: Steps) -> None:
        """Begin at the next tick. Raises ValueError while another is under way."""
        if self.busy:
            raise ValueError("The backend is being set up already; wait for it, or press Cancel")
        self._steps, self.error, self.notice, self.message, self.fraction = steps, "", "", "Starting", 0.0

    def tick(self) -> bool:
        """Continue; True when something visible changed. At the end `notice` or `error` is set."""
        if self._steps is None:
            return False
        before = (self.message, self.fraction)
        try:
            step = next(self._steps)
        except StopIteration as done:
            self._steps, self.notice = None, done.value
        except (RuntimeError, OSError) as error:
            self._steps, self.error = None, sentence(error)
        else:
            self.message, self.fraction = step.message, step.fraction
        return not self.busy or before != (self.message, self.fraction)

    def cancel(self) -> None:
        """End the set-up and its processes at once."""
        if self._steps is not None:
            self._steps.close()
            self._steps, self.notice = None, "Cancelled; what has been downloaded is used by the next Set Up Backend"


session = SetUpSession()
"""One for all windows."""


def follow_session(operator: bpy.types.Operator) -> set[str]:
    """Follow the session: by a timer with a window, by waiting in background mode, which reports an error."""
    if not bpy.app.background:
        if not bpy.app.timers.is_registered(follow):
            bpy.app.timers.register(follow, first_interval=TICK_S, persistent=True)
        return {"FINISHED"}
    printed = 0.0
    try:
        while session.busy:
            if session.tick() and session.busy and time.monotonic() - printed > _PRINT_S:
                printed = time.monotonic()
                print(f"PrimDiffusion: {session.message}", flush=True)
            time.sleep(TICK_S / 4)
    finally:
        session.cancel()
    if session.error:
        operator.report({"ERROR"}, session.error)
        return {"CANCELLED"}
    print(f"PrimDiffusion: {session.notice}", flush=True)
    return {"FINISHED"}


def follow() -> float | None:
    """The timer."""
    if session.tick():
        redraw()
    return TICK_S if session.busy else None


def redraw() -> None:
    """Redraw sidebars and preferences."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                area.tag_redraw()


OWN_LOCK = "requirements.txt"
"""In a folder of wheels: a list of packages that goes before ours."""


def installing(wheels: Path | None = None) -> Steps:
    """Steps of a set-up from the package index, or from a folder of wheels, whose own lock takes precedence.

    Raises ValueError where there are no packages for this machine or Blender may not use the network, and OSError.
    """
    compute, lock, _ = known.chosen()
    if wheels is None and not bpy.app.online_access:
        raise ValueError(setup.OFFLINE)
    if wheels is not None and (wheels / OWN_LOCK).is_file():
        lock = read_lock(wheels / OWN_LOCK)  # the user may have changed it since
    return setup.set_up(set_up_folder(), lock, compute, _module_path(), cache_folder(), wheels)


def removing() -> Steps:
    """Steps of a removal; a shared cache stays."""
    return setup.remove(set_up_folder(), None if os.environ.get(CACHE_VARIABLE) else cache_folder())


def testing() -> Steps:
    """Steps of a test of the Python that would run the backend."""
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
    """Start steps and follow them; errors become reports. `replaces`: the environment, on which children run."""
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
    return follow_session(operator)


def _release_environment() -> None:
    """End the children that run on the environment: their files could not be replaced. Raises ValueError."""
    if queue.busy:
        raise ValueError("The backend is at work; wait until it is done, or press Cancel")
    queue.close()
    drawing_child.close()


def being_set_up() -> bool:
    """Whether the backend is being set up, repaired, tested or removed."""
    return session.busy


def cancel_set_up() -> None:
    """Stop the set-up. Raises ValueError where there is none."""
    if not session.busy:
        raise ValueError(NOTHING_TO_CANCEL)
    session.cancel()
    redraw()


class PRIMDIFFUSION_OT_set_up_backend(bpy.types.Operator):
    """Download the backend's packages into a private environment and test it"""

    bl_idname = "primdiffusion.set_up_backend"
    bl_label = "Set Up Backend"
    bl_options: set[str] = set()

    repair: bpy.props.BoolProperty(name="Repair", description="Reinstall the backend", options=SKIP)
    choose: bpy.props.BoolProperty(
        name="Install from Folder",
        description="Set up the backend from a folder of wheels, without a network; every file is checked against its "
        "known hash",
        options=SKIP,
    )
    directory: bpy.props.StringProperty(
        name="Folder", description="Folder of wheels; empty: they are downloaded", subtype="DIR_PATH", options=SKIP
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        told = "choose" if properties.choose else "repair" if properties.repair else ""
        return properties.rna_type.properties[told].description if told else str(cls.__doc__)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self.choose:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self.choose or self.directory:
            folder = bpy.path.abspath(self.directory)
            if not os.path.isdir(folder):
                self.report({"ERROR"}, f"{self.directory!r:.200} is no folder: choose the one that holds the wheels")
                return {"CANCELLED"}
            return _begin(self, lambda: installing(Path(folder)))
        now = known.known()
        try:
            there = now.state == "ready" and now.about.get("compute") == known.chosen()[0]
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        if there and not self.repair:
            self.report({"INFO"}, f"{now.line}; press Repair to reinstall it")
            return {"FINISHED"}
        return _begin(self, installing)


class PRIMDIFFUSION_OT_remove_backend(bpy.types.Operator):
    """Delete the private environment and the caches; humans in your files stay as they are"""

    bl_idname = "primdiffusion.remove_backend"
    bl_label = "Remove"
    bl_options: set[str] = set()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
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
        if not any(path.exists() for path in (set_up_folder().environment, set_up_folder().downloads)):
            self.report({"ERROR"}, "There is no backend to remove: none was set up here")
            return {"CANCELLED"}
        return _begin(self, removing)


class PRIMDIFFUSION_OT_test_backend(bpy.types.Operator):
    """Start the backend and generate a test human in a few steps"""

    bl_idname = "primdiffusion.test_backend"
    bl_label = "Test"
    bl_options: set[str] = set()

    def execute(self, context: bpy.types.Context) -> set[str]:
        now = known.known()
        if not now.usable:
            remedy = "" if now.state == "named" else ": press Set Up Backend first, or name a Python"
            self.report({"ERROR"}, f"{now.line}{remedy}")
            return {"CANCELLED"}
        return _begin(self, testing, replaces=False)


def unregister() -> None:
    """End a running set-up."""
    session.cancel()
    if bpy.app.timers.is_registered(follow):
        bpy.app.timers.unregister(follow)
