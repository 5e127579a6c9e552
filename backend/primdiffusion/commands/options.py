"""Subcommands: requests of JSON-RPC, and those that the command line alone has. Needs no torch, for --help."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Annotated

from primdiffusion.formats.requests import (
    VOXEL,
    Count,
    EncodeSettings,
    GaussiansRequest,
    GenerateRequest,
    InpaintRequest,
    InterpolateRequest,
    Person,
    Pixels,
    PoseOptions,
    ProxySettings,
    ReconstructRequest,
    RenderRequest,
    Seed,
    TransferRequest,
    VaryRequest,
    Voxel,
)
from primdiffusion.formats.schema import Ending, FieldError, Option


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportCommand(ProxySettings, PoseOptions):
    """Export a human to other programs; the extension of --out selects the format: .glb, .ply, .vdb or .npz."""

    human: Person
    """A .human file (or .human.safetensors)."""
    out: Annotated[Path, Ending((".glb", ".ply", ".vdb", ".npz"))]
    """.glb: textured mesh with a skeleton; .ply: 3D Gaussians; .vdb: grids density and Cd (needs Python's module
    openvdb); .npz: such a grid as density, colour, origin, voxel. Grids have z up."""
    gaussians: Count = GaussiansRequest.limit
    """Largest number of Gaussians; about 130,000 of a human are visible."""
    voxel: Voxel = VOXEL
    """Voxel size of grids, metres; half the size shows more detail at eight times the memory."""

    def check(self) -> None:
        """Raise FieldError for a pose of a mesh, which has a skeleton, and as `PoseOptions`."""
        super().check()
        if self.pose is not None and self.out.suffix.lower() == ".glb":
            raise FieldError(("pose",), f"cannot be stored in {self.out.name}: omit it, or export a .ply, .vdb or .npz")


@dataclasses.dataclass(frozen=True, kw_only=True)
class InfoCommand:
    """Describe this installation, a checkpoint or a human, as JSON."""

    file: Annotated[Path | None, Option(positional=True)] = None
    """A .human.safetensors, a checkpoint or an encoder; without it versions, device, memory and the package's cards."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineCommand:
    """Optimise a human to match captures: person.human.safetensors and previews.

    Captures are those of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's
    layout, in several poses and from many sides: with few views the result overfits to them. Some cameras are held out
    to evaluate the result.
    """

    capture: Path
    """Folder of a capture dataset, or of one subject in it."""
    out: Path
    """Output folder."""
    subject: str | None = None
    """Name of the subject; not needed if there is only one."""
    start: str = "body"
    """Initial human: body (the bare body in grey), encoder (reconstructed from the first frame), or a
    .human.safetensors."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors) for --start encoder; the default is the one in the package."""
    steps: int = 150
    """Optimiser steps, of two images each."""
    size: Pixels = 256
    """Largest side of the images used, and width and height of the previews, pixels."""
    hold_out_cameras: int = 3
    """Number of cameras, evenly spaced, held out for evaluation."""
    seed: int = 0
    """Seed of the order of views; the same seed gives the same human."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MadePeople:
    """Fields of commands that make humans from assets."""

    assets: Path | None = None
    """MakeHuman asset folder (CC0); the default is the environment variable PRIMDIFFUSION_ASSETS."""
    count: Count = 100
    """Number of humans."""
    seed: Seed = 0
    """Seed of the first human; the others have the following seeds."""
    workers: Count = os.cpu_count() or 1
    """Processes; each needs a core and about 1.5 GB."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeopleCommand(MadePeople):
    """Make dressed, rigged humans as glTF files, from which captures are rendered."""

    out: Path
    """Folder to write person_NNNNNN/person.glb and person.json into; complete ones are skipped."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PayloadsCommand(MadePeople):
    """Make dressed humans as primitives fitted to renders of their meshes: the training set of the diffusion model.

    `payloads encode` makes them from captures instead (with its own --help).
    """

    out: Path
    """Folder to write person_NNNNNN.npz into; complete ones are skipped."""
    variants: Count = 4
    """Colourings of each human."""
    checkpoint: Path | None = None
    """Model from whose guesses fits start, so that similar humans get similar primitives; the default is the included
    one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncodePayloadsCommand(EncodeSettings):
    """Encode captures as training payloads with the trained encoder.

    Captures are those of `primdiffusion captures`, of Blender's Render Captures, or a dataset in the released code's
    layout. Running the command again resumes it.
    """

    captures: Path
    """Folder of a capture dataset."""
    out: Path
    """Output folder of NAME.npz."""
    encoder: Path | None = None
    """Trained encoder (.safetensors); the default is the one in the package."""
    people: Path | None = None
    """Folder of `primdiffusion people` that was captured, for attributes such as outfit, hair and height."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportReleasedCommand:
    """Convert the authors' primdiffusion.pt to a checkpoint for generate, render, the extension and everything else,
    and an encoder for reconstruct and payloads encode.

    The new files contain nothing of SMPL: they store the path and checksum of your SMPL file, which they need wherever
    they are used. A stage-1 file gives the encoder only.
    """

    checkpoint: Person
    """The authors' file. Only tensors are read; no code in it is executed."""
    smpl: Path
    """Your SMPL_NEUTRAL.pkl, or a body of the same format as .npz."""
    uv: tuple[Path, ...]
    """The UV layout it was trained with: SMPL's UV .obj, an .npz with vt and ft, or the pair vt.npy ft.npy."""
    out: Path
    """Output .safetensors: the denoiser, or the encoder of a stage-1 file."""
    encoder: Path | None = None
    """Output .safetensors of the encoder; the default is beside `out`, NAME.encoder.safetensors."""
    reference: Path | None = None
    """Folder of the dataset's subject seq_000016-rp_alison_rigged_002, whose first frame determined the box sizes; the
    default is the mean body in the T pose, which differs by millimetres."""


OPTIONS: dict[str, type] = {
    "generate": GenerateRequest,
    "vary": VaryRequest,
    "interpolate": InterpolateRequest,
    "inpaint": InpaintRequest,
    "transfer": TransferRequest,
    "reconstruct": ReconstructRequest,
    "refine": RefineCommand,
    "render": RenderRequest,
    "export": ExportCommand,
    "info": InfoCommand,
    "people": PeopleCommand,
    "payloads": PayloadsCommand,
    "payloads encode": EncodePayloadsCommand,
    "import-released": ImportReleasedCommand,
}
"""Records of subcommands, which are read before the command's module, which loads torch, is imported."""
