"""Convert the authors' checkpoint and the user's SMPL file to our files: `primdiffusion import-released`."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from primdiffusion.body.model import BodyModel
from primdiffusion.capture.reader import read_smpl
from primdiffusion.commands.options import ImportReleasedCommand
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.checkpoint import file_hash
from primdiffusion.diffusion.model import BETAS
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.tensor_file import under
from primdiffusion.files.whole_files import atomic_replace
from primdiffusion.primitives.anchors import grid_points_outside
from primdiffusion.primitives.body_setup import BodySetup, body_setup_from_files
from primdiffusion.primitives.primitives import K
from primdiffusion.released.imported import Reference, write_encoder, write_imported
from primdiffusion.released.inventory import PREFIX, Inventory, take_inventory
from primdiffusion.released.reading import read_weights
from primdiffusion.released.stage_one import PREFIX as STAGE_ONE
from primdiffusion.released.stage_one import encoder_tensors

SMPL_CELLS_OUTSIDE = 214
"""Number of the 1024 grid points outside every chart with SMPL's own UV (SPEC 1.2)."""
SAME_BODY = 1e-4
"""Largest difference between two files of one body, metres."""


def read_released(path: Path) -> tuple[dict[str, Tensor], Inventory]:
    """Read the tensors of a released checkpoint and what they are. Raises ValueError, naming the file, and OSError."""
    weights = read_weights(path)
    try:
        return weights, take_inventory(weights)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error


def import_released(command: ImportReleasedCommand, session: Session, report: ReportProgress) -> None:
    """Import, and print what became of every group of tensors. Raises ValueError, FileNotFoundError, OSError."""
    weights, inventory = read_released(command.checkpoint)
    print(inventory.account.table())
    if not 1 <= len(command.uv) <= 2:
        raise ValueError(f"uv names {len(command.uv)} files: give one .obj or .npz, or the pair vt.npy ft.npy")
    body_setup = body_setup_from_files(command.smpl, command.uv)
    stage_one = under(weights, STAGE_ONE) or weights
    notes = [*_about_body(stage_one, body_setup.body), _about_layout(body_setup)]
    encoder, reference = encoder_tensors(stage_one), _reference(command.reference)
    encoder_card = card = _card(command.checkpoint, inventory, encoder, command.reference, "encoder")
    encoder_out, files = command.encoder or command.out, [command.encoder or command.out]
    if inventory.unet is not None:
        encoder_out = command.encoder or command.out.with_name(f"{command.out.stem}.encoder.safetensors")
        if encoder_out.absolute() == command.out.absolute():
            raise ValueError(f"{command.out} is the output of both stages: give --encoder another name")
        files = [command.out, encoder_out]
        card = _card(command.checkpoint, inventory, under(weights, PREFIX), command.reference, "denoiser")
    with contextlib.ExitStack() as all_or_none:
        if inventory.unet is not None:
            out = all_or_none.enter_context(atomic_replace(command.out))
            write_imported(out, under(weights, PREFIX), inventory.unet, body_setup, reference, card)
        write_encoder(
            all_or_none.enter_context(atomic_replace(encoder_out)), encoder, body_setup, reference, encoder_card
        )
    print(*notes, *files, sep="\n")


def _reference(folder: Path | None) -> Reference:
    if folder is None:
        return Reference.template()
    parameters = read_smpl(folder)
    betas = torch.zeros(BETAS)
    betas[: len(parameters.betas)] = torch.from_numpy(parameters.betas)[:BETAS]
    return Reference(betas, parameters.pose(0))


def _about_body(stage_one: Mapping[str, Tensor], body: BodyModel) -> list[str]:
    """Compare the given SMPL body with the copy among the tensors of stage 1 (names without prefix)."""
    held = [
        value.reshape(body.template.shape)
        for key, value in stage_one.items()
        if key.startswith("lbs_fn.")
        and value.is_floating_point()
        and tuple(value.shape)[-2:] == body.template.shape
        and value.numel() == body.template.numel()
    ]
    if not held:
        return ["the checkpoint's own body has other vertices, or none: the SMPL file could not be compared with it"]
    difference = min(float((value.float() - body.template).abs().max()) for value in held)
    if difference <= SAME_BODY:
        return ["the SMPL file is the body that the checkpoint was trained on"]
    return [f"the SMPL file differs from the body the checkpoint was trained on by up to {1000 * difference:.1f} mm"]


def _about_layout(body_setup: BodySetup) -> str:
    outside = grid_points_outside(body_setup.body)
    return f"{outside} of {K} primitives lie outside of the UV charts; with SMPL's own UV {SMPL_CELLS_OUTSIDE} do"


def _card(
    path: Path,
    inventory: Inventory,
    network: Mapping[str, Tensor],
    reference: Path | None,
    stage: Literal["denoiser", "encoder"],
) -> dict[str, Any]:
    return {
        "name": f"released {path.stem}" + (" encoder" if stage == "encoder" else ""),
        "source": path.name,
        "source_sha256": file_hash(path),
        "source_tensors": len(inventory.account.entries),
        "parameters": sum(value.numel() for value in network.values()),
        "sizes_from": "template" if reference is None else reference.name,
        "licence": "that of the authors' weights, and of SMPL for what is made on its body",
        "limits": ["needs the SMPL file it was imported with"],
    }
