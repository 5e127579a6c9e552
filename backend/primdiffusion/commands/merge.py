"""Merge humans into voxel grids for other renderers: `merge` and `merge_frames`."""

from __future__ import annotations

import dataclasses
import functools
import time

import torch

from primdiffusion.body.pose_file import read_pose
from primdiffusion.commands.progress import Pace, ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshaped
from primdiffusion.export.merged_file import load_openvdb, upright_grid, write_grid_npz, write_grid_vdb
from primdiffusion.files.whole_files import written_whole
from primdiffusion.formats.answers import MergeAnswer, MergeFramesAnswer
from primdiffusion.formats.requests import MergeFramesRequest, MergeRequest, PosedPerson
from primdiffusion.human import Human, place_on_floor, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import Primitives


def merge(request: MergeRequest, session: Session, report: ReportProgress) -> MergeAnswer:
    """Write a grid of all humans. Raises OSError, and as load_human, place_skinned and merge."""
    began = time.perf_counter()
    if not request.out.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {request.out.parent}: create it, or choose another")
    write = write_grid_npz
    if request.out.suffix.lower() == ".vdb":
        load_openvdb()
        write = write_grid_vdb
    report("merge", 0, 1, None)
    posed = [_placed(load_human(person.human), person) for person in request.people]
    grid = upright_grid(Primitives.together(posed or _side_by_side(request)), request.voxel)
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


def _side_by_side(request: MergeRequest) -> list[Primitives]:
    pose = None if request.pose is None else read_pose(request.pose, request.frame, request.tracked_person)
    people = []
    for number, path in enumerate(request.humans):
        placed = place_on_floor(load_human(path), pose)
        aside = torch.tensor([(number - (len(request.humans) - 1) / 2) * request.apart, 0.0, 0.0])
        people.append(dataclasses.replace(placed, position=placed.position + aside))
    return people
