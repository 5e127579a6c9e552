"""The folder of a MakeHuman asset pack (CC0): where it is, what must be in it, and its files decoded once a process.

The pack is not part of this package. `open_assets` takes the folder from its argument or from the environment variable
PRIMDIFFUSION_ASSETS; the folder holds `clothes`, `hair`, `eyebrows`, `eyelashes`, `eyes` and `skins` as in
https://github.com/makehumancommunity/makehuman-assets (its `base` folder). Pictures may be .png or .jpg.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from primdiffusion.people.mhclo import ObjMesh, Proxy, read_pair

ENVIRONMENT_VARIABLE = "PRIMDIFFUSION_ASSETS"
ROOMS = ("clothes", "hair", "eyebrows", "eyelashes", "eyes", "skins")
SOURCE = "https://github.com/makehumancommunity/makehuman-assets"


class DamagedPictureError(ValueError):
    """A picture that cannot be decoded."""


class AssetsMissingError(FileNotFoundError):
    """No asset folder, or one that lacks files."""


@dataclasses.dataclass(frozen=True)
class Assets:
    """A folder that has been looked through; pictures and meshes are decoded on first use and kept by the process."""

    root: Path

    def proxy(self, name: str) -> tuple[Proxy, ObjMesh]:
        """A fitted mesh by its path without ending, such as "clothes/shoes01/shoes01"."""
        return _pair(self.root / f"{name}.mhclo", self.root / f"{name}.obj")

    def has_picture(self, name: str) -> bool:
        """Whether the folder has this picture, in either format."""
        return _picture_path(self.root, name) is not None

    def picture(self, name: str, size: int) -> UInt8[np.ndarray, "H W 4"]:
        """A picture by its path without ending, at most `size` texels wide, sRGB and alpha; read only.

        Raises:
            AssetsMissingError: the folder has no such picture.
            DamagedPictureError: it cannot be decoded.
        """
        path = _picture_path(self.root, name)
        if path is None:
            raise AssetsMissingError(
                f"The asset folder {self.root} has no {name}.png or .jpg; get the pack from {SOURCE} (with git-lfs)."
            )
        return _decoded(path, size)

    def files(self, name: str) -> tuple[str, ...]:
        """Everything of an asset that people are made from, as paths in the folder: mesh, fitting, pictures."""
        meshes = [f"{name}{ending}" for ending in (".mhclo", ".obj") if (self.root / f"{name}{ending}").is_file()]
        pictures = [_picture_path(self.root, f"{name}{ending}") for ending in ("", "_diffuse", "_ao")]
        return (*meshes, *(path.relative_to(self.root).as_posix() for path in pictures if path))

    def pictures(self, folder: str, contains: str = "") -> tuple[str, ...]:
        """Names (without ending, sorted) of the pictures in a folder whose file name contains a word."""
        found = {
            f"{folder}/{path.stem}"
            for path in (self.root / folder).glob("*")
            if path.suffix in (".png", ".jpg") and contains in path.stem and _is_picture(path)
        }
        return tuple(sorted(found))


def open_assets(folder: str | os.PathLike[str] | None = None, required: tuple[str, ...] = ()) -> Assets:
    """Find the asset folder: the argument, or else the environment variable PRIMDIFFUSION_ASSETS.

    Args:
        folder: the asset folder, or None to ask the environment.
        required: meshes that must be there, as paths without ending; each needs a .mhclo and a .obj.

    Raises:
        AssetsMissingError: no folder was named, it is not there, or it lacks rooms or required files.
    """
    named = folder if folder is not None else os.environ.get(ENVIRONMENT_VARIABLE)
    if not named:
        raise AssetsMissingError(
            f"No MakeHuman asset folder was given; pass one (--assets) or set {ENVIRONMENT_VARIABLE}. "
            f"The pack is CC0: {SOURCE}, folder 'base'."
        )
    root = Path(named).expanduser().resolve()
    if not root.is_dir():
        raise AssetsMissingError(
            f"The MakeHuman asset folder {root} is not there; pass the folder that holds {', '.join(ROOMS)}."
        )
    lacking = [room for room in ROOMS if not (root / room).is_dir()]
    files = [f"{name}{ending}" for name in required for ending in (".mhclo", ".obj")]
    lacking += [file for file in files if not (root / file).is_file()]
    if lacking:
        shown = ", ".join(lacking[:6]) + (", ..." if len(lacking) > 6 else "")
        raise AssetsMissingError(
            f"The MakeHuman asset folder {root} is incomplete, it lacks {shown}; "
            f"get the pack's folder 'base' from {SOURCE}."
        )
    return Assets(root)


@functools.lru_cache(maxsize=256)
def _pair(mhclo: Path, obj: Path) -> tuple[Proxy, ObjMesh]:
    """A cached pair of files."""
    return read_pair(mhclo, obj)


def _is_picture(path: Path) -> bool:
    """Whether a file is more than the pointer that git-lfs leaves where it has not fetched."""
    return path.is_file() and path.stat().st_size > 1024


def _picture_path(root: Path, name: str) -> Path | None:
    """The file of a picture, if the folder has it."""
    for ending in (".png", ".jpg"):
        path = root / f"{name}{ending}"
        if _is_picture(path):
            return path
    return None


@functools.lru_cache(maxsize=48)
def _decoded(path: Path, size: int) -> UInt8[np.ndarray, "H W 4"]:
    """Decode, shrink and freeze one picture; colour is weighted by alpha when it shrinks, so that edges keep theirs."""
    try:
        with Image.open(path) as file:
            picture = file.convert("RGBA")
    except (OSError, SyntaxError) as error:
        raise DamagedPictureError(f"{path} cannot be decoded ({error}); fetch it again.") from error
    if picture.width > size:
        box = (size, round(picture.height * size / picture.width))
        picture = picture.convert("RGBa").resize(box, Image.Resampling.BOX).convert("RGBA")
    array = np.array(picture)
    array.setflags(write=False)
    return array
