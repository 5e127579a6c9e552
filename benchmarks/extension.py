"""Figures of the extension: registration, building, frames, motion, memory, Cycles, a soak test.

    python benchmarks/extension.py --json docs/results/extension.json
    python benchmarks/extension.py --also 5_3=.venv53/bin/python --json ...     # the same on another bpy: names + _5_3

Each part runs in its own process (`extension.py part PART FOLDER`, where FOLDER has the `person/` that `primdiffusion
generate` wrote); the real child generates. `--quick` renders smaller pictures and soaks for five rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import blender_isolated  # before bpy
import bpy
import numpy as np
import psutil
import record

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
REGISTRATIONS = 7
SEED, FRAMES, MOTION_FRAMES = 7, 48, 1500
UNDO_STEPS = 4  # instead of 32: each step holds a person's data blocks, and growth is measured with a full stack
WARM_ROUNDS = 8
"""Bounded caches fill in the first rounds: of the child, of Blender's undo, of the C library."""


def main() -> None:
    """Measure with this interpreter, then with those of --also."""
    parser = record.command_line(__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller pictures, five rounds")
    parser.add_argument("--parts", nargs="*", default=[*PARTS], help="parts to measure; the file's other figures stay")
    parser.add_argument(
        "--also",
        nargs="*",
        default=[f"5_3={ROOT / '.venv53/bin/python'}"] if (ROOT / ".venv53/bin/python").exists() else [],
        help="NAME=PYTHON of other versions of bpy",
    )
    arguments = parser.parse_args()
    figures = measure(Path(sys.executable), arguments)
    for other in arguments.also:
        name, _, python = other.partition("=")
        figures |= {f"{key}_{name}": value for key, value in measure(Path(python), arguments).items()}
    if arguments.json is not None and arguments.json.exists() and set(arguments.parts) != set(PARTS):
        about = record.surroundings()
        before = json.loads(arguments.json.read_text(encoding="utf-8"))
        figures = {name: value for name, value in before.items() if name not in about} | figures
    record.report(figures, arguments.json)


def measure(python: Path, arguments: argparse.Namespace) -> dict[str, float | str | None]:
    """Figures of the chosen parts on one version of bpy."""
    with tempfile.TemporaryDirectory(prefix="primdiffusion_extension_") as name:
        folder = Path(name)
        generate = [sys.executable, "-m", "primdiffusion", "generate", "--seed", "7", "--compact"]
        command = [*generate, "--out", str(folder / "person")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        found: dict[str, float | str | None] = {"bpy": version(python)}
        if "register" in arguments.parts:
            times = [run(python, "register", folder)["register_ms"] for _ in range(REGISTRATIONS)]
            found["register_ms"] = min(times)  # the minimum: other programs only add time
        options = {"merged": ["--size", "128"], "soak": ["--rounds", "5"]} if arguments.quick else {}
        for part in ("person", "memory", "merged", "soak"):
            if part in arguments.parts:
                found |= run(python, part, folder, *options.get(part, []))
        return found


def version(python: Path) -> str:
    command = [str(python), "-c", "import bpy; print('bpy', bpy.app.version_string)"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True, encoding="utf-8").stdout.splitlines()
    return next(line.removeprefix("bpy ") for line in lines if line.startswith("bpy "))


def run(python: Path, part: str, folder: Path, *options: str) -> dict[str, float | None]:
    """The figures of one part; ends with the part's output if it fails."""
    command = [str(python), __file__, "part", part, str(folder), *options]
    environment = {**os.environ, "PRIMDIFFUSION_PYTHON": sys.executable, "PYTHONPYCACHEPREFIX": str(folder / "bytes")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Blender keeps byte code from its first start on
    print(f"{part} ...", file=sys.stderr, flush=True)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, encoding="utf-8")
    lines = [line for line in done.stdout.splitlines() if line.startswith("figures ")]
    if not lines:
        raise SystemExit(f"{part} failed on {python}:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
    return json.loads(lines[-1].removeprefix("figures "))


def register(_arguments: argparse.Namespace) -> dict[str, float]:
    """Milliseconds to enable the add-on, as at each start of Blender, with byte code already compiled."""
    start = time.perf_counter()
    import blender_primdiffusion

    blender_primdiffusion.register()
    return {"register_ms": 1e3 * (time.perf_counter() - start)}


def person(arguments: argparse.Namespace) -> dict[str, float | None]:
    """One person: objects and file, building, frames with volumes shown, motion; objects that Delete leaves."""
    _enable(arguments)
    from blender_primdiffusion.jobs.parts import complete_humans
    from blender_primdiffusion.scene.build import build_human

    context = bpy.context
    blend = Path(bpy.data.filepath)
    empty_bytes = blend.stat().st_size
    start = time.perf_counter()
    folder = arguments.folder / "person"
    armature = build_human(context, folder / "person.human.safetensors")
    building = time.perf_counter() - start
    objects = len(bpy.data.objects)
    bpy.ops.wm.save_mainfile(compress=True)
    blend_mb = (blend.stat().st_size - empty_bytes) / 1e6
    start = time.perf_counter()
    bpy.ops.primdiffusion.volumes_in_viewport()
    context.view_layer.update()
    built = building + time.perf_counter() - start
    context.view_layer.objects.active = armature

    motion = _amass_file(arguments.folder / "amass.npz")
    start = time.perf_counter()
    bpy.ops.primdiffusion.import_motion(filepath=str(motion))
    keyed = time.perf_counter() - start
    figures: dict[str, float | None] = {
        "add_human_seconds": building,
        "build_seconds": built,
        "objects_of_a_human": objects,
        "blend_mb_a_human": blend_mb,
        "amass_1500_seconds": keyed,
        "frame_ms": _frame_ms(context.scene),
    }
    armature.select_set(True)
    bpy.ops.object.delete()
    complete_humans()  # as a timer does in a window
    return {**figures, "objects_left_after_delete": len(bpy.data.objects)}


def memory(arguments: argparse.Namespace) -> dict[str, float]:
    """Blender's memory for one person after all grids are read."""
    _enable(arguments)
    from blender_primdiffusion.scene.build import build_human

    record.trim()
    before = record.resident_mb()
    build_human(bpy.context, arguments.folder / "person" / "person.human.safetensors")
    bpy.ops.primdiffusion.volumes_in_viewport()
    bpy.context.view_layer.update()
    record.trim()
    return {"ram_per_human_mb": record.resident_mb() - before}


def merged(arguments: argparse.Namespace) -> dict[str, float]:
    """The same Cycles frame with 1024 volumes and with one merged volume."""
    _enable(arguments)
    from cycles_preview import setup_cycles_preview

    from blender_primdiffusion.scene.build import build_human

    folder = arguments.folder / "person"
    build_human(bpy.context, folder / "person.human.safetensors")
    setup_cycles_preview(bpy.context.scene, size=arguments.size, samples=1, world=0.48)
    many = _render_seconds(arguments.folder / "cycles_volumes.png")
    start = time.perf_counter()
    bpy.ops.primdiffusion.merge()
    merging = time.perf_counter() - start
    one = _render_seconds(arguments.folder / "cycles_merged.png")
    return {
        "cycles_volumes_seconds": many,
        "cycles_merged_seconds": one,
        "merged_speedup": many / one,
        "merge_seconds": merging,
    }


def soak(arguments: argparse.Namespace) -> dict[str, float]:
    """Generate, pose and delete repeatedly; measures memory growth, stray files and stray processes."""
    _enable(arguments)
    from blender_primdiffusion.jobs.queue import queue
    from blender_primdiffusion.scene.human import humans, parts_of, session_folder

    context, megabytes, blender = bpy.context, [], []
    context.preferences.edit.undo_steps = UNDO_STEPS
    rng = np.random.default_rng(SEED)
    for number in range(arguments.rounds):
        bpy.context.scene.primdiffusion.steps = arguments.steps
        bpy.ops.primdiffusion.generate(seed=SEED + number)
        armature = humans(context.scene)[0]
        for bone in armature.pose.bones:
            bone.rotation_quaternion = (1.0, *rng.normal(0, 0.1, 3))
        context.view_layer.update()
        bpy.data.batch_remove(parts_of(armature))
        bpy.ops.outliner.orphans_purge(do_recursive=True)
        shutil.rmtree(session_folder(), ignore_errors=True)
        record.trim()
        blender.append(record.resident_mb())
        megabytes.append(blender[-1] + children_mb())
        print(f"round {number + 1}: {blender[-1]:.0f} MB, {megabytes[-1]:.0f} MB with the child", flush=True)
    expected = {"shot.blend", "shot.blend1"}
    stray = [path for path in (arguments.folder / "scene").rglob("*") if path.is_file() and path.name not in expected]
    stray += [path for path in Path(bpy.app.tempdir).rglob("*") if path.is_file()]
    for path in stray:
        print(f"left behind: {path}", flush=True)
    queue.close()
    time.sleep(3.0)
    return {
        "soak_rounds": float(arguments.rounds),
        "soak_memory_mb": megabytes[-1],
        "soak_memory_growth_mb": growth_mb(megabytes),
        "soak_growth_mb_a_person": growth_mb_a_round(megabytes),
        "soak_growth_mb_a_person_blender": growth_mb_a_round(blender),
        "soak_stray_files": float(len(stray)),
        "soak_stray_processes": float(len(psutil.Process().children(recursive=True))),
    }


def _enable(arguments: argparse.Namespace) -> None:
    """Save a new file in its own folder, and enable the add-on from the checkout."""
    import blender_primdiffusion

    (arguments.folder / "scene").mkdir(exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.folder / "scene" / "shot.blend"))
    blender_primdiffusion.register()


def _amass_file(path: Path) -> Path:
    """A file like those of AMASS: SMPL-H, z up, every body joint moving."""
    rng = np.random.default_rng(SEED)
    times = np.arange(MOTION_FRAMES) / 120.0
    poses = 0.3 * np.sin(times[:, None] * rng.uniform(1, 6, 156) + rng.uniform(0, 6, 156))
    poses[:, :3] = [np.pi / 2, 0.0, 0.0]  # upright, with z up
    trans = np.stack([0.8 * times, np.zeros_like(times), np.full_like(times, 0.9)], -1)
    np.savez(path, poses=poses, trans=trans, mocap_framerate=120.0, betas=np.zeros(16), gender="neutral")
    return path


def _frame_ms(scene: bpy.types.Scene) -> float:
    """Median milliseconds of a frame change, including the evaluation of the dependency graph."""
    times = []
    for number in range(1, FRAMES + 1):
        start = time.perf_counter()
        scene.frame_set(number)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times[4:]))


def _render_seconds(path: Path) -> float:
    start = time.perf_counter()
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(path))
    return time.perf_counter() - start


PARTS = {"register": register, "person": person, "memory": memory, "merged": merged, "soak": soak}


def run_part() -> None:
    """Run one part and print its figures on the last line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--steps", type=int, default=10)
    arguments = parser.parse_args()
    figures = PARTS[arguments.part](arguments)
    print("\nfigures " + json.dumps(figures), flush=True)
    blender_isolated.remove()
    os._exit(0)  # bpy as a module may hang at exit


def children_mb() -> float:
    """Resident memory of all processes below this one, in MB."""
    return sum(child.memory_info().rss for child in psutil.Process().children(recursive=True)) / 1e6


def growth_mb(resident: Sequence[float]) -> float:
    """Difference in MB between the medians of the last and the first third of the rounds after the warm-up."""
    rounds = _after_warming(resident)
    third = max(1, len(rounds) // 3)
    return float(np.median(rounds[-third:]) - np.median(rounds[:third]))


def growth_mb_a_round(resident: Sequence[float]) -> float:
    """Slope in MB per round of the best-fitting line through the rounds after the warm-up."""
    rounds = _after_warming(resident)
    return float(np.polyfit(np.arange(len(rounds)), rounds, 1)[0]) if len(rounds) > 1 else 0.0


def _after_warming(resident: Sequence[float]) -> Sequence[float]:
    return resident[min(WARM_ROUNDS, len(resident) - 2) :]


if __name__ == "__main__":
    record.run(main, part=run_part)
