"""What a user meets first: how soon a generated human of 1024 volumes stands, and what it then costs Blender.

    python scripts/window/look.py --blender blender --out one \\
        --scenes stalls redraw visible_humans opening turning playing    # twice more, into two and three
    python scripts/window/look.py --blender blender --scenes undo_and_timers --out undo
    python benchmarks/viewport.py --blender blender --json viewport.json
    python benchmarks/first_sight.py --json docs/results/first_sight.json \\
        --window one/figures.json two/figures.json three/figures.json undo/figures.json viewport.json

Measured without a window, which adds its redraws: the seconds from the child's answer until the human stands
(stand_seconds), in one step (longest_step_seconds); the seconds in which its volumes are written afterwards;
memory with undo, milliseconds of a frame change, and rows of the Outliner as Blender opens them (collections open,
objects closed). second_* are the same with another human in the scene. panels_open, sidebar_px, panel_classes and
operators are of `sidebar.py`.
first_press_seconds is from the press of Generate Human until the human stands where nothing was compiled yet,
first_press_ratio that to the faster of two later presses, each in a Blender of its own.
proxy_cpu_seconds is the processor time of `primdiffusion export` of a textured mesh, of the default checkpoint's human
with seed 7.

Figures of a real window are of `--window`: the median of its files, or the longest stall, or wait, of
all.
in_view_seconds_window is from the child's answer until a view shows the human; longest_stall_s the longest that
Blender's main loop was blocked, its own redraws included, from the answer until the volumes are written and the views
at rest; longest_stall_entering_s the same until the human is in view, longest_stall_extension_s within the extension's
own functions; redraw_ratio a redraw in Solid with a hidden human against an empty scene's and the extension's drawing;
open_to_visible_seconds from the moment when Blender has read a .blend (open_seconds_window) until its human is in view
for the first time in this Blender; coarse_after_stop_seconds from the last turn of a view until a whole picture of it
is drawn, the slowest of four; orbit_ratio_1 a redraw of a turning view with a human against an empty scene's,
playback_ratio_2 a frame of two walking humans with its redraw likewise; window_load the machine's load before.
first_human_visible_share and second_human_visible_share are of the pixels of the first two humans in Blender's factory
scene, those that neither other objects nor panels hide; window_rounds and window_crashes of undo and redo among timers
that change data. Without `--window`, those that the JSON file has already are kept.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
import sidebar
from march_people import checkered_human
from primdiffusion.human_file import save_human
from record import command_line, report, resident_mb, trim

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from blender_primdiffusion.scene import build
from blender_primdiffusion.scene.armature import keyframe_poses
from blender_primdiffusion.scene.edit import select_human
from blender_primdiffusion.scene.place import stand_at_cursor
from blender_primdiffusion.scene.volume_nodes import write_volumes

FRAMES = 60
_ENTERING = (
    "stand_seconds_window",
    "in_view_seconds_window",
    "longest_stall_entering_s",
    "longest_stall_s",
    "longest_stall_extension_s",
    "window_load",
)
WINDOW = (
    "window_blender",
    "window_gpu",
    *_ENTERING,
    *(f"second_{name}" for name in _ENTERING),
    *(f"redraw_{name}" for name in ("empty_ms", "armature_ms", "person_ms", "drawing_ms", "ratio")),
    "open_seconds_window",
    "open_to_visible_seconds",
    "opened_refined_seconds",
    "coarse_after_stop_seconds",
    "orbit_empty_ms",
    "orbit_ratio_1",
    "playback_empty_ms",
    "playback_ratio_2",
    "first_human_visible_share",
    "second_human_visible_share",
    "window_rounds",
    "window_crashes",
    "viewport_error_999",
    "viewport_ms_1080p_gpu",
)
"""Figures that other programs measure."""


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--window", type=Path, nargs="+", help="figures of scripts/window/look.py and of viewport.py")
    arguments = parser.parse_args()
    recorded = arguments.json and arguments.json.exists()
    before = json.loads(arguments.json.read_text(encoding="utf-8")) if recorded else {}
    with tempfile.TemporaryDirectory(prefix="primdiffusion_first_sight_") as folder:
        figures = measured(Path(folder)) | sidebar.measured()
        figures["proxy_cpu_seconds"] = proxy_cpu_seconds(Path(folder))
        first, *later = (press_seconds(Path(folder) / "cache") for _ in range(3))
        figures |= {"first_press_seconds": first, "first_press_ratio": first / min(later)}
    read = [json.loads(path.read_text(encoding="utf-8")) for path in arguments.window or ()]
    window = in_window(read) if read else before
    report({**{name: window.get(name) for name in WINDOW}, **figures}, arguments.json)


def in_window(records: list[dict]) -> dict[str, float | str | None]:
    """One value for each figure of WINDOW that any of these records has."""
    found: dict[str, float | str | None] = {}
    for name in WINDOW:
        values = [record[name] for record in records if record.get(name) is not None]
        if values and isinstance(values[0], str):
            found[name] = values[0]
        elif values:
            worst = "longest" in name or name in ("coarse_after_stop_seconds", "window_crashes")
            found[name] = max(values) if worst else statistics.median(values)
    return found


def measured(folder: Path) -> dict[str, float]:
    """Figures of a human in an empty file, and of a second one beside them."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    figures: dict[str, float] = {}
    for seed, prefix in enumerate(("", "second_")):
        human = checkered_human(seed)
        person = folder / "person.human.safetensors"
        save_human(person, human)
        figures |= {prefix + name: value for name, value in one_human(person).items()}
    return figures


def proxy_cpu_seconds(folder: Path) -> float:
    """Processor seconds of a child process that exports a mesh with its texture."""
    primdiffusion = [sys.executable, "-m", "primdiffusion"]
    subprocess.run([*primdiffusion, "generate", "--seed", "7", "--out", str(folder / "seven")], check=True)
    person, before = folder / "seven" / "person.human.safetensors", children_seconds()
    subprocess.run([*primdiffusion, "export", str(person), "--out", str(folder / "proxy.glb")], check=True)
    return children_seconds() - before


def press_seconds(cache: Path) -> float:
    """Seconds of Generate Human in a new Blender whose compiled functions are in `cache`."""
    press = """
import time, blender_isolated, bpy, blender_primdiffusion
blender_primdiffusion.register()
began = time.perf_counter()
bpy.ops.primdiffusion.generate(seed=7)
print("pressed", time.perf_counter() - began, len(bpy.context.selected_objects), flush=True)
"""
    places = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1])])
    about = {"PYTHONPATH": places, "PRIMDIFFUSION_PYTHON": sys.executable, "PRIMDIFFUSION_CACHE": str(cache)}
    command = [sys.executable, "-c", press]
    done = subprocess.run(command, env={**os.environ, **about}, capture_output=True, text=True, check=True)
    return float(next(line for line in done.stdout.splitlines() if line.startswith("pressed")).split()[1])


def children_seconds() -> float:
    times = os.times()
    return times.children_user + times.children_system


def one_human(person: Path) -> dict[str, float]:
    trim()
    memory = resident_mb()
    found: list[bpy.types.Object] = []
    figures = {"stand_seconds": seconds(lambda: found.append(enter(person)))}
    figures["longest_step_seconds"] = figures["stand_seconds"]
    trim()
    figures["person_memory_mb"] = resident_mb() - memory
    figures["person_frame_ms"] = frame_ms(found[0])
    figures["outliner_rows"] = outliner_rows(found[0].users_collection[0])
    figures["volumes_seconds"] = seconds(lambda: write_volumes(found[0]))
    return figures


def enter(person: Path) -> bpy.types.Object:
    """What blocks the window."""
    human = build.build_human(bpy.context, person)
    stand_at_cursor(bpy.context, human)
    bpy.context.view_layer.update()
    select_human(bpy.context, human)
    bpy.ops.ed.undo_push(message="Generate Human")
    return human


def seconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def frame_ms(armature: bpy.types.Object) -> float:
    """Median milliseconds of a frame change while all joints move."""
    angles = np.random.default_rng(0).normal(0, 0.2, (FRAMES, 24))
    rotations = np.broadcast_to(np.eye(3), (FRAMES, 24, 3, 3)).copy()
    rotations[..., 0, 0] = rotations[..., 1, 1] = np.cos(angles)
    rotations[..., 1, 0], rotations[..., 0, 1] = np.sin(angles), -np.sin(angles)
    keyframe_poses(armature, np.arange(1.0, FRAMES + 1), rotations, np.zeros((FRAMES, 3)))
    times = [seconds(lambda frame=frame: bpy.context.scene.frame_set(frame)) for frame in range(1, FRAMES + 1)]
    return 1e3 * float(np.median(times[4:]))


def outliner_rows(collection: bpy.types.Collection) -> int:
    """Rows of a collection that was never opened or closed: objects are inside the closed rows of their parents, where
    both are in the same collection."""
    here = set(collection.objects)
    return (
        1
        + sum(obj.parent not in here for obj in collection.objects)
        + sum(outliner_rows(child) for child in collection.children)
    )


if __name__ == "__main__":
    main()
