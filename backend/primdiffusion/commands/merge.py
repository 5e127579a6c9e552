"""Merge a human into voxel grids for other renderers: `merge`."""

from __future__ import annotations

import functools
import time

import torch

from primdiffusion.commands.progress import Pace, ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshaped
from primdiffusion.export.merged_file import upright_grid, write_grid_npz
from primdiffusion.files.whole_files import written_whole
from primdiffusion.formats.answers import MergeAnswer
from primdiffusion.formats.requests import MergeRequest, PosedPerson
from primdiffusion.human import Human, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import Primitives


def merge(request: MergeRequest, session: Session, report: ReportProgress) -> MergeAnswer:
    """Write the grids one by one, each atomically, so that another program can load the finished ones.

    Grids written before an error stay. Raises OSError, and as load_human, place_skinned and merge.
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
    return MergeAnswer(files=files, seconds=round(time.perf_counter() - began, 3))


def _placed(human: Human, person: PosedPerson) -> Primitives:
    if person.betas is not None:
        human = reshaped(human, torch.tensor(person.betas, dtype=torch.float32))
    joints, matrix = (torch.tensor(numbers, dtype=torch.float32) for numbers in (person.joints, person.object))
    return place_skinned(human, joints, matrix)
