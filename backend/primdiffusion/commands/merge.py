"""Merge humans into voxel grids for other renderers: `merge` and `merge_frames`."""

from __future__ import annotations

import functools
import time

import torch

from primdiffusion.commands.progress import Pace, ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshaped
from primdiffusion.export.merged_file import grid_writer, upright_grid, write_grid_npz
from primdiffusion.files.whole_files import written_whole
from primdiffusion.formats.answers import MergeAnswer, MergeFramesAnswer
from primdiffusion.formats.requests import MergeFramesRequest, MergeRequest, PosedPerson
from primdiffusion.human import Human, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import Primitives


def merge(request: MergeRequest, session: Session, report: ReportProgress) -> MergeAnswer:
    """Write a grid of all humans. Raises OSError, and as load_human, place_skinned and merge."""
    began = time.perf_counter()
    if not request.out.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {request.out.parent}: create it, or choose another")
    write = grid_writer(request.out)
    report("merge", 0, 1, None)
    posed = [_placed(load_human(person.human), person) for person in request.people]
    grid = upright_grid(Primitives.together(posed), request.voxel)
    with written_whole(request.out) as path:
        write(path, grid)
        report("merge", 1, 1, 0.0)  # the last chance to cancel
    shape, seconds = list(grid.density.shape), round(time.perf_counter() - began, 3)
    return MergeAnswer(out=request.out, shape=shape, seconds=seconds)


def merge_frames(request: MergeFramesRequest, session: Session, report: ReportProgress) -> MergeFramesAnswer:
    """Write the grids one by one, each atomically, so that another program can load the finished ones.

    Raises as `merge`; grids written before an error stay.
    """
    began, pace, count = time.perf_counter(), Pace(), len(request.people)
    request.out_dir.mkdir(parents=True, exist_ok=True)
    load = functools.lru_cache(maxsize=1)(load_human)
    report("merge", 0, count, None)
    files = []
    for index, person in enumerate(request.people):
        file = request.out_dir / f"{index:04d}.npz"
        with written_whole(file) as path:
            write_grid_npz(path, upright_grid(_placed(load(person.human), person), request.voxel))
        files.append(file)
        report("merge", index + 1, count, pace.left(index + 1, count))
    return MergeFramesAnswer(files=files, seconds=round(time.perf_counter() - began, 3))


def _placed(human: Human, person: PosedPerson) -> Primitives:
    if person.betas is not None:
        human = reshaped(human, torch.tensor(person.betas, dtype=torch.float32))
    joints, matrix = (torch.tensor(numbers, dtype=torch.float32) for numbers in (person.joints, person.object))
    return place_skinned(human, joints, matrix)
