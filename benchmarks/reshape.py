"""Measures how long moving a shape slider takes on a person of 1024 volumes.

`python benchmarks/reshape.py --json reshape.json`, or `--quick` with fewer moves. Milliseconds are medians of wall
time. reshape_ms: setting the betas, which moves bones, body mesh and volumes. reshape_evaluate_ms: Blender's work
before it can draw again, mostly rebuilding the dependency graph, as after every edit of bones. graph_ms: that rebuild
alone, triggered by linking an empty object. body_file_mb is the file on disk that all people on one body share;
human_npz_mb is the file that the backend hands over.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
from march_people import checkered_human
from primdiffusion.human_file import export_for_blender
from record import command_line, report

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from blender_primdiffusion.scene.body_file import shape_model_of
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.reshape import reshape

MOVES, QUICK_MOVES = 30, 5


def milliseconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return 1000 * (time.perf_counter() - began)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    folder = Path(tempfile.mkdtemp(prefix="reshape_", dir=bpy.app.tempdir))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    export_for_blender(folder / "human.npz", checkered_human(0))
    person = build_human(bpy.context, folder / "human.npz")
    bpy.context.view_layer.update()
    model, rng = shape_model_of(person), np.random.default_rng(0)
    setting, evaluating, resting, linking = [], [], [], []
    for _ in range(QUICK_MOVES if given.quick else MOVES):
        betas = rng.normal(size=10)
        resting.append(milliseconds(lambda betas=betas: model.rest(betas)))
        setting.append(milliseconds(lambda betas=betas: reshape(person, betas)))
        evaluating.append(milliseconds(bpy.context.view_layer.update))
        bpy.context.scene.collection.objects.link(bpy.data.objects.new("Empty", None))
        linking.append(milliseconds(bpy.context.view_layer.update))
    (body,) = (folder / "shot_humans").glob("body_*.npz")
    figures = {
        "reshape_rest_ms": statistics.median(resting),
        "reshape_ms": statistics.median(setting),
        "reshape_evaluate_ms": statistics.median(evaluating),
        "graph_ms": statistics.median(linking),
        "reshape_volumes": sum(obj.type == "VOLUME" for obj in person.all_objects),
        "body_file_mb": body.stat().st_size / 1e6,
        "human_npz_mb": (folder / "human.npz").stat().st_size / 1e6,
    }
    report(figures, given.json)


if __name__ == "__main__":
    main()
