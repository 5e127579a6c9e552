"""Humans as other files: `export`, `proxy`, `gaussians` and `merge`."""

from __future__ import annotations

import functools
import time
from pathlib import Path

import torch

from primdiffusion.body.model import read_pose
from primdiffusion.commands.options import ExportCommand
from primdiffusion.commands.progress import EtaEstimator, ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.export.gaussians import gaussians_of, write_gaussians
from primdiffusion.export.merged_file import grid_writer, upright_grid, write_grid_npz
from primdiffusion.export.proxy import ARRAYS, TEXTURE, mesh_proxy, write_proxy_arrays, write_proxy_glb
from primdiffusion.files.whole_files import atomic_folder, atomic_path
from primdiffusion.formats.answers import GaussiansAnswer, MergeAnswer, ProxyAnswer
from primdiffusion.formats.requests import GaussiansRequest, MergeRequest, PosedPerson, ProxyRequest
from primdiffusion.human import Human, place_on_floor, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import Primitives


def proxy(request: ProxyRequest, session: Session, report: ReportProgress) -> ProxyAnswer:
    """Write both files or none.

    Raises OSError first of all if the folder cannot be written to; raises as load_human and mesh_proxy.
    """
    began = time.perf_counter()
    with atomic_folder(request.out_dir) as folder:
        report("load", 0, 4, None)
        human = _shaped(load_human(request.person), request.betas)
        made = mesh_proxy(human, request, lambda stage, done, total: report(stage, done, total + 1, None))
        report("write", 3, 4, 0.0)
        write_proxy_arrays(folder, made)
        report("write", 4, 4, 0.0)  # the last chance to cancel
    return ProxyAnswer(
        proxy=request.out_dir / ARRAYS,
        texture=request.out_dir / TEXTURE,
        triangles=len(made.faces),
        betas=human.betas.tolist(),
        seconds=round(time.perf_counter() - began, 3),
    )


def gaussians(request: GaussiansRequest, session: Session, report: ReportProgress) -> GaussiansAnswer:
    """Raises OSError, and as load_human."""
    began = time.perf_counter()
    report("load", 0, 2, None)
    primitives = _placed(load_human(request.person.human), request.person)
    report("gaussians", 1, 2, None)
    splats = gaussians_of(primitives, request.limit)
    report("write", 2, 2, 0.0)
    write_gaussians(request.out, splats)
    seconds = round(time.perf_counter() - began, 3)
    return GaussiansAnswer(out=request.out, gaussians=len(splats.opacity), seconds=seconds)


def export(command: ExportCommand, session: Session, report: ReportProgress) -> Path:
    """Write a file of the format that its extension names."""
    if not command.out.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {command.out.parent}: create it, or choose another")
    ending, write_grid = command.out.suffix.lower(), grid_writer(command.out)
    human = load_human(command.human)
    if ending == ".glb":
        write_proxy_glb(command.out, mesh_proxy(human, command), human.provenance)
        return command.out
    pose = None if command.pose is None else read_pose(command.pose, command.frame, command.tracked_person)
    placed = place_on_floor(human, pose)
    if ending == ".ply":
        write_gaussians(command.out, gaussians_of(placed, command.gaussians))
    else:
        with atomic_path(command.out) as path:
            write_grid(path, upright_grid(placed, command.voxel))
    return command.out


def merge(request: MergeRequest, session: Session, report: ReportProgress) -> MergeAnswer:
    """Write the grids one by one, each atomically, so that another program can load the finished ones.

    Grids written before an error stay. Raises OSError, and as load_human, place_skinned and merge.
    """
    began, pace, count = time.perf_counter(), EtaEstimator(), len(request.people)
    request.out_dir.mkdir(parents=True, exist_ok=True)
    load = functools.lru_cache(maxsize=1)(load_human)
    report("merge", 0, count, None)
    files = []
    for index, person in enumerate(request.people):
        file = request.out_dir / f"{index:04d}.npz"
        with atomic_path(file) as path:
            write_grid_npz(path, upright_grid(_placed(load(person.human), person), request.voxel))
        files.append(file)
        report("merge", index + 1, count, pace.left(index + 1, count))
    return MergeAnswer(files=files, seconds=round(time.perf_counter() - began, 3))


def _placed(human: Human, person: PosedPerson) -> Primitives:
    joints, matrix = (torch.tensor(numbers, dtype=torch.float32) for numbers in (person.joints, person.object))
    return place_skinned(_shaped(human, person.betas), joints, matrix)


def _shaped(human: Human, betas: list[float] | None) -> Human:
    """The human with other betas if given. Raises ValueError for a wrong number of them."""
    return human if betas is None else reshape_human(human, torch.tensor(betas, dtype=torch.float32))
