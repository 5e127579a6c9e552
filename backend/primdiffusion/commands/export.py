"""Humans as other files: `export`, `proxy` and `gaussians`."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from primdiffusion.body.pose_file import read_pose
from primdiffusion.commands.options import ExportCommand
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshaped
from primdiffusion.export.gaussians import gaussians_of, write_gaussians
from primdiffusion.export.merged_file import grid_writer, upright_grid
from primdiffusion.export.proxy import ARRAYS, TEXTURE, mesh_proxy, write_proxy_arrays, write_proxy_glb
from primdiffusion.files.whole_files import staged, written_whole
from primdiffusion.formats.answers import GaussiansAnswer, ProxyAnswer
from primdiffusion.formats.requests import GaussiansRequest, ProxyRequest
from primdiffusion.human import Human, place_on_floor, place_skinned
from primdiffusion.human_file import load_human


def proxy(request: ProxyRequest, session: Session, report: ReportProgress) -> ProxyAnswer:
    """Write both files or none.

    Raises OSError first of all if the folder cannot be written to; raises as load_human and mesh_proxy.
    """
    began = time.perf_counter()
    with staged(request.out_dir) as folder:
        report("load", 0, 4, None)
        human = _shaped(request.person, request.betas)
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
    human = _shaped(request.person, request.betas)
    if request.object is None or request.joints is None:
        primitives = place_on_floor(human)
    else:
        joints, matrix = (torch.tensor(numbers, dtype=torch.float32) for numbers in (request.joints, request.object))
        primitives = place_skinned(human, joints, matrix)
    report("gaussians", 1, 2, None)
    splats = gaussians_of(primitives, request.limit)
    report("write", 2, 2, 0.0)
    write_gaussians(request.out, splats)
    seconds = round(time.perf_counter() - began, 3)
    return GaussiansAnswer(out=request.out, gaussians=len(splats.opacity), seconds=seconds)


def _shaped(person: Path, betas: list[float] | None) -> Human:
    """Load a human, with other betas if given. Raises ValueError for a wrong number of them, and as load_human."""
    human = load_human(person)
    return human if betas is None else reshaped(human, torch.tensor(betas, dtype=torch.float32))


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
        with written_whole(command.out) as path:
            write_grid(path, upright_grid(placed, command.voxel))
    return command.out
