"""Counts the files of this repository that run between pressing Generate and the human in the scene, and those of the
extension that run while a .blend with that human is opened (open_walk_files).

    python benchmarks/walk.py
    python benchmarks/walk.py --json FILE

Blender's module runs the operator from this checkout and the real child answers; both are traced. A file is counted
when one of its functions runs. Functions that run only while modules are imported are not counted, nor are compiled
functions that only other compiled functions call, because no trace sees them.
"""

from __future__ import annotations

import os
import runpy
import shlex
import sys
import tempfile
import threading
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parents[1]
SEED, STEPS = 7, 3
IS_FUNCTION = 0x1  # CO_OPTIMIZED: not set for bodies of modules and classes


class Trace:
    """Appends each file below `folder` to `log` when its first function runs outside an import."""

    def __init__(self, folder: Path, log: Path):
        self._folder = f"{folder}{os.sep}"
        self._log = log
        self._passed: set[str] = set()

    def start(self) -> None:
        """Trace this thread and those that start from now on."""
        threading.setprofile(self._profile)
        sys.setprofile(self._profile)

    def stop(self) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    def _profile(self, frame: FrameType, event: str, _argument: object) -> None:
        if event != "call":
            return
        code = frame.f_code
        path = code.co_filename
        if path in self._passed or not path.startswith(self._folder) or not code.co_flags & IS_FUNCTION:
            return
        if not _is_importing(frame):
            self._passed.add(path)
            with self._log.open("a", encoding="utf-8") as log:  # immediately: the child may be killed
                log.write(f"{path}\n")


def main() -> None:
    # not in the child; blender_isolated before bpy
    import blender_isolated
    import record

    arguments = record.command_line(__doc__).parse_args()

    with tempfile.TemporaryDirectory(prefix="primdiffusion_walk_") as name:
        folder = Path(name)
        logs = {program: folder / program for program in ("extension", "backend", "open")}
        os.environ["PRIMDIFFUSION_PYTHON"] = str(_traced_python(folder / "python", logs["backend"]))
        volumes = _generate(folder, logs)
        figures: dict[str, float | None] = {"walk_volumes": volumes}
        for program, log in logs.items():
            passed = log.read_text(encoding="utf-8").splitlines()
            print(f"{program}:", *(Path(path).relative_to(ROOT) for path in passed), sep="\n  ", end="\n\n")
            figures["open_walk_files" if program == "open" else f"walk_{program}_files"] = len(passed)
        record.report(figures, arguments.json)
    sys.stdout.flush()
    blender_isolated.remove()
    os._exit(0)  # bpy as a module may hang at exit


def _generate(folder: Path, logs: dict[str, Path]) -> int:
    """Generate a person, save and open the file; returns the number of volumes in the scene."""
    import bpy  # after blender_isolated

    sys.path.insert(0, str(ROOT))
    import blender_primdiffusion

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "walk.blend"))
    blender_primdiffusion.register()
    trace = Trace(ROOT / "blender_primdiffusion", logs["extension"])
    trace.start()
    try:
        bpy.context.scene.primdiffusion.steps = STEPS
        bpy.ops.primdiffusion.generate(seed=SEED)
    finally:
        trace.stop()
    volumes = len(bpy.data.volumes)
    bpy.ops.wm.save_mainfile()
    trace = Trace(ROOT / "blender_primdiffusion", logs["open"])
    trace.start()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.context.view_layer.update()
    trace.stop()
    blender_primdiffusion.unregister()
    return volumes


def _traced_python(path: Path, log: Path) -> Path:
    """An executable like this Python that traces the child (`-m primdiffusion.serve`)."""
    python, script = shlex.quote(sys.executable), shlex.quote(str(Path(__file__).resolve()))
    traced = f'if [ "$1" = -m ]; then shift; exec {python} {script} --as-child {shlex.quote(str(log))} "$@"; fi'
    path.write_text(f'#!/bin/sh\n{traced}\nexec {python} "$@"\n', encoding="utf-8")
    path.chmod(0o755)
    return path


def _run_child(log: Path, module: str, *options: str) -> None:
    sys.argv = [module, *options]
    Trace(ROOT / "backend" / "primdiffusion", log).start()
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _is_importing(frame: FrameType) -> bool:
    caller: FrameType | None = frame
    while caller is not None:
        if caller.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        caller = caller.f_back
    return False


if __name__ == "__main__":
    if sys.argv[1:2] == ["--as-child"]:
        _run_child(Path(sys.argv[2]), *sys.argv[3:])
    else:
        main()
