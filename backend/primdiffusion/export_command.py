"""The command `primdiffusion export`: a person for programs that know nothing of primitives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

if TYPE_CHECKING:
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a person for other programs; the ending of --out says what: .glb, .obj or .ply."""

    human: tyro.conf.Positional[Path]
    """A .human file (or .human.safetensors)."""
    out: Path
    """.glb: textured mesh with a skeleton; .obj: the mesh alone, with .mtl and .png beside it; .ply: 3D Gaussians."""
    triangles: int = 20_000
    """Of the mesh, at most."""
    texture: int = 2048
    """Pixels a side of the mesh's texture."""
    gaussians: int = 400_000
    """Gaussians, at most."""
    pose: Path | None = None
    """.json or .npz with 72 axis-angle numbers (24 joints x 3, radians), for Gaussians; without it the T pose. Meshes
    are in the T pose."""
    frame: int = 0
    """Which frame of a pose file that holds several."""

    def run(self) -> None:
        """Exports, and prints the file's path."""
        from primdiffusion.human_file import load_human

        write = _writer(self.out)
        if self.pose is not None and write is not _write_gaussians:
            raise ValueError(f"{self.out.name} cannot hold a pose: leave --pose out, or write Gaussians to a .ply")
        if self.frame and self.pose is None:
            raise ValueError(f"frame {self.frame} was asked for without a pose file: name one with --pose")
        if not self.out.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self.out.parent}: make it first, or choose another")
        write(self, load_human(self.human))
        print(self.out)


def _writer(out: Path) -> Callable[[Export, Human], None]:
    writers = {".glb": _write_mesh, ".obj": _write_mesh, ".ply": _write_gaussians}
    if out.suffix.lower() not in writers:
        raise ValueError(f"{out.name!r} has none of the endings {', '.join(writers)}: choose one")
    return writers[out.suffix.lower()]


def _write_mesh(asked: Export, human: Human) -> None:
    from primdiffusion.export.proxy import ProxySettings, mesh_proxy
    from primdiffusion.export.proxy_files import write_proxy_glb, write_proxy_obj

    proxy = mesh_proxy(human, ProxySettings(triangles=asked.triangles, texture_px=asked.texture))
    if asked.out.suffix.lower() == ".glb":
        write_proxy_glb(asked.out, proxy, human.provenance)
    else:
        write_proxy_obj(asked.out, proxy)


def _write_gaussians(asked: Export, human: Human) -> None:
    from primdiffusion.export.gaussian_file import write_gaussians
    from primdiffusion.export.gaussians import gaussians_of
    from primdiffusion.human import place
    from primdiffusion.pose_file import read_pose

    pose = None if asked.pose is None else read_pose(asked.pose, asked.frame)
    write_gaussians(asked.out, gaussians_of(place(human, pose), asked.gaussians))
