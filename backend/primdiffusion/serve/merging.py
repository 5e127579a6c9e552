"""The child's jobs about renderers that are not ours: `merge`, `merge_frames` and `fit_gain`."""

from __future__ import annotations

import functools
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from primdiffusion.export.merged_file import upright_grid, write_grid_npz
from primdiffusion.formats.requests import DENSITY_GAIN
from primdiffusion.human import Human, framing, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.gain import fit_gain, unclamped_alpha
from primdiffusion.reshaping import reshaped
from primdiffusion.serve.draw_params import PersonParams
from primdiffusion.serve.merge_params import FitGainParams, MergeFramesParams, MergeParams
from primdiffusion.serve.progress import Pace, Report
from primdiffusion.staging import written_whole

GAIN_VIEWS = 4
"""Around the person."""
GAIN_PIXELS = 128
"""A side of each view; 4 x 128 x 128 rays meet a standing person about ten thousand times."""


def merge_people(params: MergeParams, report: Report) -> dict[str, Any]:
    """Writes one grid of everybody, z up; returns its path and shape.

    Raises what load_human, place_skinned and merge do.
    """
    began = time.perf_counter()
    report("merge", 0, 1, None)
    primitives = _together(params.people)
    with written_whole(params.out) as path:
        shape = _write(path, primitives, params.voxel)
        report("merge", 1, 1, 0.0)  # the last chance to cancel
    return {"out": params.out, "shape": shape, "seconds": round(time.perf_counter() - began, 3)}


def merge_frames(params: MergeFramesParams, report: Report) -> dict[str, Any]:
    """Writes a grid for each frame, one by one and each of them whole, so that a program may take them in meanwhile.

    Returns their paths. Raises as `merge_people`; what is there by then stays.
    """
    began, pace, count = time.perf_counter(), Pace(), len(params.people)
    folder = Path(params.out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    load = functools.lru_cache(maxsize=1)(load_human)
    report("merge", 0, count, None)
    files = []
    for index, person in enumerate(params.people):
        with written_whole(folder / f"{index:04d}.npz") as path:
            _write(path, _placed(load(person.human), person), params.voxel)
        files.append(str(folder / f"{index:04d}.npz"))
        report("merge", index + 1, count, pace.left(index + 1, count))
    return {"files": files, "seconds": round(time.perf_counter() - began, 3)}


def fit_gain_of(params: FitGainParams, report: Report) -> dict[str, Any]:
    """The density gain for exponential renderers, from views around the person (see `fit_gain`); also raises as it."""
    primitives = _together(params.people)
    reached = []
    for view in range(GAIN_VIEWS):
        report("fit", view, GAIN_VIEWS, None)
        camera = framing(primitives, 2 * math.pi * view / GAIN_VIEWS, GAIN_PIXELS, GAIN_PIXELS)
        reached.append(unclamped_alpha(primitives, camera).numpy())
    fit = fit_gain(np.stack(reached))
    return {
        "gain": round(fit.gain, 3),
        "error": round(fit.error, 5),
        "gain_before": DENSITY_GAIN,
        "error_before": round(fit.error_before, 5),
        "rays": fit.rays,
    }


def _together(people: list[PersonParams]) -> Primitives:
    return Primitives.together([_placed(load_human(person.human), person) for person in people])


def _placed(human: Human, person: PersonParams) -> Primitives:
    if person.betas is not None:
        human = reshaped(human, torch.tensor(person.betas))
    return place_skinned(human, torch.tensor(person.joints), torch.tensor(person.object))


def _write(path: Path, primitives: Primitives, voxel: float) -> list[int]:
    grid = upright_grid(primitives, voxel)
    write_grid_npz(path, grid)
    return list(grid.density.shape)
