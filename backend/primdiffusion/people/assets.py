"""Access to a MakeHuman asset pack (CC0): validation, and decoded files cached per process.

The pack is not part of this package. `open_assets` takes its folder as an argument or from the environment variable
PRIMDIFFUSION_ASSETS; the folder contains `clothes`, `hair`, `eyebrows`, `eyelashes`, `eyes` and `skins` as does `base`
in https://github.com/makehumancommunity/makehuman-assets. Images may be .png or .jpg.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from primdiffusion.files.regular_files import as_file_error, real_path
from primdiffusion.geometry.pictures import decoded, opened_picture
from primdiffusion.people.mhclo import ObjMesh, Proxy, read_pair

ENVIRONMENT_VARIABLE = "PRIMDIFFUSION_ASSETS"
SUBFOLDERS = ("clothes", "hair", "eyebrows", "eyelashes", "eyes", "skins")
SOURCE = "https://github.com/makehumancommunity/makehuman-assets"


@dataclasses.dataclass(frozen=True)
class Assets:
    """A validated asset folder; images and meshes are decoded on first use and cached."""

    root: Path

    def proxy(self, name: str) -> tuple[Proxy, ObjMesh]:
        """Load a proxy and its mesh by path without extension, such as "clothes/shoes01/shoes01"."""
        return _pair(self.root / f"{name}.mhclo", self.root / f"{name}.obj")

    def has_picture(self, name: str) -> bool:
        """Whether the folder has this image, in either format."""
        return _picture_path(self.root, name) is not None

    def picture(self, name: str, size: int) -> UInt8[np.ndarray, "H W 4"]:
        """Load an image by path without extension, at most `size` pixels wide: read-only sRGB and alpha.

        Raises:
            FileNotFoundError: the folder has no such image.
            FileError: it cannot be decoded.
        """
        path = _picture_path(self.root, name)
        if path is None:
            raise FileNotFoundError(
                f"{name}.png or .jpg is missing from the asset folder {self.root}: get it from {SOURCE} (with git-lfs)"
            )
        return _decoded(path, size)

    def pictures(self, folder: str, contains: str = "") -> tuple[str, ...]:
        """Names (without extension, sorted) of the images in a folder whose file name contains a word."""
        found = {
            f"{folder}/{path.stem}"
            for path in (self.root / folder).glob("*")
            if path.suffix in (".png", ".jpg") and contains in path.stem and _is_picture(path)
        }
        return tuple(sorted(found))


def open_assets(folder: str | os.PathLike[str] | None = None, required: tuple[str, ...] = ()) -> Assets:
    """Open and validate the asset folder.

    Args:
        folder: the asset folder; None for that of the environment variable PRIMDIFFUSION_ASSETS.
        required: meshes that must exist, as paths without extension; each needs a .mhclo and a .obj.

    Raises:
        FileNotFoundError: no folder was given, it does not exist, or subfolders or required files are missing.
    """
    named = folder if folder is not None else os.environ.get(ENVIRONMENT_VARIABLE)
    if not named:
        raise FileNotFoundError(
            f"no MakeHuman asset folder was given: pass one with --assets or set {ENVIRONMENT_VARIABLE}; "
            f"the pack is CC0: {SOURCE}, folder 'base'"
        )
    root = real_path(Path(named).expanduser())
    if not root.is_dir():
        raise FileNotFoundError(
            f"the MakeHuman asset folder {root} does not exist: pass the folder with {', '.join(SUBFOLDERS)}"
        )
    missing = [name for name in SUBFOLDERS if not (root / name).is_dir()]
    files = [f"{name}{ending}" for name in required for ending in (".mhclo", ".obj")]
    missing += [file for file in files if not (root / file).is_file()]
    if missing:
        listed = ", ".join(missing[:6]) + (", ..." if len(missing) > 6 else "")
        raise FileNotFoundError(
            f"missing from the MakeHuman asset folder {root}: {listed}; get the pack's folder 'base' from {SOURCE}"
        )
    return Assets(root)


@functools.lru_cache(maxsize=256)
def _pair(mhclo: Path, obj: Path) -> tuple[Proxy, ObjMesh]:
    return read_pair(mhclo, obj)


def _is_picture(path: Path) -> bool:
    """Whether a file is larger than the pointer that git-lfs leaves for files it has not fetched."""
    return path.is_file() and path.stat().st_size > 1024


def _picture_path(root: Path, name: str) -> Path | None:
    for ending in (".png", ".jpg"):
        path = root / f"{name}{ending}"
        if _is_picture(path):
            return path
    return None


@functools.lru_cache(maxsize=48)
def _decoded(path: Path, size: int) -> UInt8[np.ndarray, "H W 4"]:
    """Decode and shrink an image; shrinking weights colour by alpha, so that edges keep their colour."""
    with as_file_error(path, "cannot be decoded", "fetch it again", OSError), opened_picture(path) as picture:
        array = decoded(picture, "RGBA") if picture.width <= size else _shrunk(picture, size)
    array.setflags(write=False)
    return array


def _shrunk(picture: Image.Image, width: int) -> UInt8[np.ndarray, "H W 4"]:
    size = (width, max(1, round(picture.height * width / picture.width)))
    return np.array(picture.convert("RGBA").convert("RGBa").resize(size, Image.Resampling.BOX).convert("RGBA"))
