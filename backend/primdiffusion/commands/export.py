"""Export humans: `primdiffusion export`, and `proxy`, `gaussians` and `human_npz` of JSON-RPC."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from primdiffusion.commands.request import ReportProgress, check_betas, check_ending, check_numbers, check_size, parse
from primdiffusion.formats import requests
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.whole_files import staged

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProxyRequest:
    """Write the textured mesh of a human in the rest pose."""

    person: Path
    """A .human.safetensors file."""
    out_dir: Path
    """Output folder of proxy.npz and proxy.png; created if missing."""
    betas: list | None = None
    """Shape coefficients; None for those of the file."""
    triangles: int = requests.TRIANGLES
    """Largest number of triangles."""
    texture_px: int = requests.TEXTURE_SIZE
    """Width and height of proxy.png, pixels."""
    spacing: float = requests.VOXEL
    """Spacing of the grid that the surface is extracted from, metres."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_betas(self.betas)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Write both files or none.

        Raises OSError first of all if the folder cannot be written to; raises as load_human and mesh_proxy.
        """
        # torch is loaded late
        from primdiffusion.export.proxy import ARRAYS, TEXTURE, ProxySettings, mesh_proxy, write_proxy_arrays

        began = time.perf_counter()
        settings = ProxySettings(self.spacing, self.triangles, self.texture_px)
        with staged(self.out_dir) as folder:
            report("load", 0, 4, None)
            human = _shaped(self.person, self.betas)
            made = mesh_proxy(human, settings, lambda stage, done, total: report(stage, done, total + 1, None))
            report("write", 3, 4, 0.0)
            write_proxy_arrays(folder, made)
            report("write", 4, 4, 0.0)  # the last chance to cancel
        return {
            "proxy": str(self.out_dir / ARRAYS),
            "texture": str(self.out_dir / TEXTURE),
            "triangles": len(made.faces),
            "betas": human.betas.tolist(),
            "seconds": round(time.perf_counter() - began, 3),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussiansRequest:
    """Write a human as 3D Gaussians, posed by an armature."""

    person: Path
    """A .human.safetensors file."""
    out: Path
    """Output .ply."""
    object: list | None = None
    """[3][4] world matrix of the armature object; y up, metres. Without it and `joints`: the T pose at the origin."""
    joints: list | None = None
    """[24][3][4] rest to posed in object space, SMPL's joint order."""
    betas: list | None = None
    """Shape coefficients; None for those of the file."""
    limit: int = requests.GAUSSIANS
    """Largest number of Gaussians."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_ending(self.out, ".ply")
        check_betas(self.betas)
        if (self.object is None) != (self.joints is None):
            raise ValueError("object and joints go together: give both, or neither for the T pose")
        if self.object is not None:
            check_numbers("object", self.object, (3, 4))
            check_numbers("joints", self.joints, (len(JOINT_NAMES), 3, 4))
        if self.limit < 1:
            raise ValueError(f"{self.limit} Gaussians were requested: choose 1 or more")

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Raises OSError, and as load_human."""
        import torch  # late

        # torch is loaded late
        from primdiffusion.export.gaussians import gaussians_of, write_gaussians
        from primdiffusion.human import place, place_skinned

        began = time.perf_counter()
        report("load", 0, 2, None)
        human = _shaped(self.person, self.betas)
        if self.object is None or self.joints is None:
            primitives = place(human)
        else:
            primitives = place_skinned(
                human, torch.tensor(self.joints, dtype=torch.float32), torch.tensor(self.object, dtype=torch.float32)
            )
        report("gaussians", 1, 2, None)
        splats = gaussians_of(primitives, self.limit)
        report("write", 2, 2, 0.0)
        write_gaussians(self.out, splats)
        seconds = round(time.perf_counter() - began, 3)
        return {"out": str(self.out), "gaussians": len(splats.opacity), "seconds": seconds}


@dataclasses.dataclass(frozen=True, kw_only=True)
class HumanNpzRequest:
    """Write the files of `generate` for a saved human."""

    person: Path
    """A .human.safetensors file."""
    out_dir: Path
    """Output folder; created if missing."""
    size: int = requests.PICTURE_SIZE
    """Width and height of the previews, pixels."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_size(self.size)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Write all files or none. Raises OSError, and as load_human."""
        # torch is loaded late
        from primdiffusion.commands.output import FILES, write_human
        from primdiffusion.human_file import load_human

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("load", 0, 1, None)
            human = load_human(self.person)
            report("write", 0, 1, None)
            write_human(folder, human, self.size)
            report("write", 1, 1, 0.0)  # the last chance to cancel
        return {**FILES.in_folder(self.out_dir), "seconds": round(time.perf_counter() - began, 3)}


def _shaped(person: Path, betas: list | None) -> Human:
    """Load a human, with other betas if given. Raises ValueError for a wrong number of them, and as load_human."""
    import torch  # late

    # torch is loaded late
    from primdiffusion.human_file import load_human
    from primdiffusion.reshaping import reshaped

    human = load_human(person)
    return human if betas is None else reshaped(human, torch.tensor(betas, dtype=torch.float32))


@dataclasses.dataclass(frozen=True)
class ExportCommand:
    """Export a human to other programs; the extension of --out selects the format: .glb, .obj or .ply."""

    human: tyro.conf.Positional[Path]
    """A .human file (or .human.safetensors)."""
    out: Path
    """.glb: textured mesh with a skeleton; .obj: the mesh alone, with .mtl and .png; .ply: 3D Gaussians."""
    triangles: int = requests.TRIANGLES
    """Largest number of triangles of the mesh."""
    texture: int = requests.TEXTURE_SIZE
    """Width and height of the texture, pixels."""
    gaussians: int = requests.GAUSSIANS
    """Largest number of Gaussians."""
    pose: Path | None = None
    """.json or .npz with 72 axis-angle numbers (24 joints x 3, radians), for Gaussians; the default is the T pose, as
    for meshes."""
    frame: int = 0
    """Frame of a pose file with several."""

    def check(self) -> None:
        """See `RequestRecord`."""
        write = _writer(self.out)
        if self.pose is not None and write is not _write_gaussians:
            raise ValueError(f"{self.out.name} cannot store a pose: omit --pose, or export Gaussians to a .ply")
        if self.frame and self.pose is None:
            raise ValueError(f"frame {self.frame} was requested without a pose file: give one with --pose")
        if not self.out.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self.out.parent}: create it, or choose another")

    def export(self) -> None:
        """Export, and print the path."""
        from primdiffusion.human_file import load_human  # torch is loaded late

        _writer(self.out)(self, load_human(self.human))
        print(self.out)


def _writer(out: Path) -> Callable[[ExportCommand, Human], None]:
    writers = {".glb": _write_mesh, ".obj": _write_mesh, ".ply": _write_gaussians}
    check_ending(out, *writers)
    return writers[out.suffix.lower()]


def _write_mesh(command: ExportCommand, human: Human) -> None:
    # torch is loaded late
    from primdiffusion.export.proxy import ProxySettings, mesh_proxy, write_proxy_glb, write_proxy_obj

    proxy = mesh_proxy(human, ProxySettings(triangles=command.triangles, texture_px=command.texture))
    if command.out.suffix.lower() == ".glb":
        write_proxy_glb(command.out, proxy, human.provenance)
    else:
        write_proxy_obj(command.out, proxy)


def _write_gaussians(command: ExportCommand, human: Human) -> None:
    # torch is loaded late
    from primdiffusion.export.gaussians import gaussians_of, write_gaussians
    from primdiffusion.human import place
    from primdiffusion.pose_file import read_pose

    pose = None if command.pose is None else read_pose(command.pose, command.frame)
    write_gaussians(command.out, gaussians_of(place(human, pose), command.gaussians))


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    parse(ExportCommand, arguments, "export").export()
