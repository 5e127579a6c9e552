"""The training set of stage 2: payloads as bytes, in a folder with one file a person."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from primdiffusion.body.model import LARGEST_BETA, default_body, measure
from primdiffusion.diffusion.conditioning import Attributes
from primdiffusion.diffusion.model import BETAS
from primdiffusion.files.arrays import LARGEST_NUMBER, array_shape, read_arrays
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.people.wardrobe import attribute_labels
from primdiffusion.primitives.primitives import K, Payload, S

_ABOUT = ("betas", "attributes", "full_density")
_COLOURINGS = ("voxels",), ("delta_scale",)
_VOXELS = (K, S, S, S, 4)


@dataclasses.dataclass(frozen=True)
class PersonVariants:
    """One geometry with several colourings, or several payloads of a captured subject."""

    voxels: UInt8[Tensor, "n k 8 8 8 4"]
    """sRGB-encoded colour and relative density of each colouring."""
    delta_scale: Float[Tensor, "n k 3"]
    """Factors on the half extents of the anchors; 1 if the file has none."""
    betas: Float[Tensor, "10"]
    attributes: tuple[Attributes, ...]
    """Attributes of each colouring, as named in `primdiffusion.people.wardrobe`; height and weight from the betas."""
    full_density: float
    """Density of a byte value of 255, 1/m."""

    def payload(self, variant: int) -> Payload:
        """Return one colouring in float32."""
        return payload_of_bytes(self.voxels[variant], self.delta_scale[variant], self.full_density)


def payload_of_bytes(
    voxels: UInt8[Tensor, "*b k 8 8 8 4"], delta_scale: Float[Tensor, "*b k 3"], full_density: float
) -> Payload:
    """Convert stored voxels and delta scales to payloads in float32."""
    values = voxels.movedim(-1, -4).float() / 255
    return Payload(decode_srgb(values[..., :3, :, :, :]), values[..., 3, :, :, :] * full_density, delta_scale.float())


def read_payloads(path: Path) -> PersonVariants:
    """Read a file. Raises ValueError if it is damaged or of another shape."""
    with _damage_named(path):
        arrays = read_arrays(path, (*_ABOUT, *_COLOURINGS[0]), _COLOURINGS[1])
        outline = _outline_of(arrays, arrays["voxels"].shape)
    voxels, scale = _colourings(path, arrays)
    return PersonVariants(voxels, scale, outline.betas, outline.known(), outline.full_density)


def _colourings(path: Path, arrays: Mapping[str, NDArray]) -> tuple[Tensor, Tensor]:
    """Return voxels and delta scales of all colourings. Raises ValueError if they are of another shape."""
    voxels = torch.from_numpy(arrays["voxels"])
    if voxels.dtype != torch.uint8 or tuple(voxels.shape[1:]) != _VOXELS:
        raise ValueError(
            f"{path} holds voxels {voxels.dtype} {tuple(voxels.shape)}; uint8 [n, {K}, {S}, {S}, {S}, 4] is needed"
        )
    scale = torch.from_numpy(arrays["delta_scale"]) if "delta_scale" in arrays else torch.ones(len(voxels), K, 3)
    fits = tuple(scale.shape) == (len(voxels), K, 3)  # before it becomes larger as float32
    scale = scale.float() if fits else scale
    if not fits or not (torch.isfinite(scale) & (scale > 0)).all():
        raise ValueError(f"{path} holds delta_scale {tuple(scale.shape)}; positive [{len(voxels)}, {K}, 3] is needed")
    return voxels, scale


@dataclasses.dataclass(frozen=True)
class Outline:
    """Content of a file without its voxels."""

    variants: int
    betas: Float[Tensor, "10"]
    stored: Mapping[str, Any]
    """Stored attributes."""
    full_density: float

    def colourings(self) -> list[dict[str, Any]]:
        """Stored attributes of each colouring."""
        return list(self.stored.get("variants", [self.stored] * self.variants))

    def known(self) -> tuple[Attributes, ...]:
        """`PersonVariants.attributes`."""
        measures = measure(default_body().shape(self.betas))
        body = {"height": measures.height, "weight": measures.weight}
        return tuple({**attribute_labels(colouring), **body} for colouring in self.colourings())


def _damage_named(path: Path) -> contextlib.AbstractContextManager[None]:
    remedy = "write it again with `primdiffusion payloads`"
    return as_file_error(path, "is not a payload file or is damaged", remedy, OSError)


def read_outline(path: Path) -> Outline:
    """Read a file without its voxels. Raises ValueError if it is damaged."""
    with _damage_named(path):
        return _outline_of(read_arrays(path, _ABOUT), array_shape(path, "voxels"))


def _outline_of(arrays: Mapping[str, NDArray], shape: tuple[int, ...]) -> Outline:
    """Check what a file holds beside its voxels, which have `shape`."""
    if tuple(shape[1:]) != _VOXELS or not shape[0]:
        raise ValueError(f"voxels of shape {shape}, not [n, {K}, {S}, {S}, {S}, 4]")
    betas = torch.from_numpy(arrays["betas"]).float()
    if tuple(betas.shape) != (BETAS,) or not torch.isfinite(betas).all():
        raise ValueError(f"betas of shape {tuple(betas.shape)}, not {BETAS} finite numbers")
    if betas.abs().max() > LARGEST_BETA:
        raise ValueError(f"a beta of {betas.abs().max():.3g}, beyond {LARGEST_BETA:g}")
    stored, count = parse_json(str(arrays["attributes"])), shape[0]
    if not isinstance(stored, dict):
        raise ValueError("attributes that are no JSON object")
    variants = stored.get("variants", [stored] * count)
    if not isinstance(variants, list) or len(variants) != count or not all(isinstance(v, dict) for v in variants):
        raise ValueError(f"attributes that do not describe {count} colourings")
    density = float(arrays["full_density"])
    if not 0 < density <= LARGEST_NUMBER:
        raise ValueError(f"a full density of {density}")
    return Outline(count, betas, stored, density)


class PersonFolder:
    """A folder with one file per person, read on demand; their order depends on the names of the files only."""

    def __init__(self, folder: Path) -> None:
        """Inspect all files without reading voxels.

        Raises:
            FileNotFoundError: there are fewer than two.
            ValueError: one is damaged, or people have several full densities.
        """
        self.paths = find_payloads(folder)
        self.outlines = [read_outline(path) for path in self.paths]
        self.names = [path.stem for path in self.paths]
        self.variants = [outline.variants for outline in self.outlines]
        self.full_density = one_density([outline.full_density for outline in self.outlines])

    def known(self, index: int) -> tuple[Attributes, ...]:
        """Return the attributes of each colouring of a person."""
        return self.outlines[index].known()

    def person(self, index: int) -> PersonVariants:
        """Read a person. Raises ValueError, naming a damaged file, and OSError."""
        return read_payloads(self.paths[index])

    def variant(self, index: int, number: int) -> tuple[UInt8[Tensor, "k 8 8 8 4"], Float[Tensor, "k 3"]]:
        """Read voxels and delta scales of one colouring. Raises as `person`."""
        with _damage_named(self.paths[index]):
            arrays = read_arrays(self.paths[index], *_COLOURINGS)
        voxels, scale = _colourings(self.paths[index], arrays)
        return voxels[number], scale[number]


def find_payloads(folder: Path) -> list[Path]:
    """Return the files of a folder, sorted. Raises FileNotFoundError if there are fewer than two."""
    paths = sorted(folder.glob("*.npz"))
    if len(paths) < 2:
        raise FileNotFoundError(
            f"{folder} holds {len(paths)} humans (*.npz): make some with `primdiffusion payloads --out {folder}`"
        )
    return paths


def one_density(densities: Sequence[float]) -> float:
    """Return the common full density; ValueError if they differ."""
    if len(found := set(densities)) != 1:
        raise ValueError(
            f"humans with full densities {sorted(found)} cannot be trained together: regenerate them with one"
        )
    return found.pop()
