"""The jobs that hand a person who exists to other programs, and to Blender."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from primdiffusion.export.gaussian_file import write_gaussians
from primdiffusion.export.gaussians import gaussians_of
from primdiffusion.export.proxy import ProxySettings, mesh_proxy
from primdiffusion.export.proxy_files import ARRAYS, TEXTURE, write_proxy_arrays
from primdiffusion.human import Human, place, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.person_folder import FILES, write_person
from primdiffusion.reshaping import reshaped
from primdiffusion.serve.export_params import GaussiansParams, HumanNpzParams, ProxyParams
from primdiffusion.serve.progress import Report
from primdiffusion.staging import staged


def proxy(params: ProxyParams, report: Report) -> dict[str, Any]:
    """Makes the textured mesh of a person at rest and writes it to `out_dir`, both files or none.

    Raises OSError before any work if the folder cannot be written to; what load_human and mesh_proxy raise.
    """
    began = time.perf_counter()
    settings = ProxySettings(params.spacing, params.triangles, params.texture_px)
    out = Path(params.out_dir)
    with staged(out) as folder:
        report("load", 0, 4, None)
        human = _shaped(params)
        made = mesh_proxy(human, settings, lambda stage, done, total: report(stage, done, total + 1, None))
        report("write", 3, 4, 0.0)
        write_proxy_arrays(folder, made)
        report("write", 4, 4, 0.0)  # the last chance to cancel
    return {
        "proxy": str(out / ARRAYS),
        "texture": str(out / TEXTURE),
        "triangles": len(made.faces),
        "betas": human.betas.tolist(),
        "seconds": round(time.perf_counter() - began, 3),
    }


def gaussians(params: GaussiansParams, report: Report) -> dict[str, Any]:
    """Writes a person as 3D Gaussians, posed as an armature poses them. Raises OSError and what load_human does."""
    began = time.perf_counter()
    report("load", 0, 2, None)
    human = _shaped(params)
    if params.object is None or params.joints is None:
        primitives = place(human)
    else:
        primitives = place_skinned(human, torch.tensor(params.joints), torch.tensor(params.object))
    report("gaussians", 1, 2, None)
    splats = gaussians_of(primitives, params.limit)
    report("write", 2, 2, 0.0)
    write_gaussians(params.out, splats)
    return {"out": params.out, "gaussians": len(splats.opacity), "seconds": round(time.perf_counter() - began, 3)}


def human_npz(params: HumanNpzParams, report: Report) -> dict[str, Any]:
    """Writes the files of generate for a person who exists, all or none. Raises OSError and what load_human does."""
    began = time.perf_counter()
    out = Path(params.out_dir)
    with staged(out) as folder:
        report("load", 0, 1, None)
        human = load_human(params.person)
        report("write", 0, 1, None)
        write_person(folder, human, params.size)
        report("write", 1, 1, 0.0)  # the last chance to cancel
    return {**FILES.in_folder(out), "seconds": round(time.perf_counter() - began, 3)}


def _shaped(params: ProxyParams | GaussiansParams) -> Human:
    """The person with the shape that is asked for. Raises ValueError for another number of betas."""
    human = load_human(params.person)
    return human if params.betas is None else reshaped(human, torch.tensor(params.betas))
