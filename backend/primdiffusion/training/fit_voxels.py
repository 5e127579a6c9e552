"""Direct targets of stage 1: voxels fitted to all images of a training subject, in the boxes the encoder starts from.

An image teaches a voxel through the sum along a ray; these targets teach each voxel by itself, so that a step needs no
marching and far fewer steps are needed. They are fitted once, half a minute a subject (`render.inverse`), and say how
much each voxel counts in images: the diagonal of J^T W J. With it, the square distance of voxels is the square error of
the images, but for the products of neighbours.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import time
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from primdiffusion.capture.conditioning import conditioning_views, default_betas, spread_cameras
from primdiffusion.capture.reader import Captures, Subject
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.model import EncoderModel, frames_of
from primdiffusion.encoder.network import Encoder
from primdiffusion.files.arrays import read_arrays, write_deflated
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.whole_files import written_whole
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import K, Payload, S
from primdiffusion.reconstruction.from_captures import targets_of
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import InverseSettings, fit_payload, influence
from primdiffusion.training.fit_losses import RESIDUAL

SETTINGS = InverseSettings(iterations=8, pull=0.003, smoothness=0.02)
"""Weaker penalties than those of a human from a few images: here all sides are seen, in several poses."""
SIDE = 256
"""Size of the images that are fitted, pixels."""
MOST_IMAGES, MOST_INFLUENCES = 60, 20
"""Images that voxels are fitted to, and those whose influence is measured: 35 MB of memory each."""
START_VIEWS = 16
"""Images of the first frame from which the fit starts, at most."""
UNSEEN = 1e-9
"""Weight of voxels that no image shows: the fit left them where the encoder starts."""
PLACING = ("appearance", "masks", "facing", "frames", "extent", "thickness", "full_density")
"""Settings of the encoder on which its boxes, and the values from which the fit starts, depend."""
STEPS = 65535
"""Colours and relative densities are stored as multiples of 1 / STEPS."""


@dataclasses.dataclass(frozen=True)
class FittedVoxels(TensorRecord):
    """Fitted voxels of one subject, or a batch."""

    rgb: Float32[Tensor, "*b k 3 8 8 8"]
    """Linear colours, 0 ... 1."""
    density: Float32[Tensor, "*b k 8 8 8"]
    """Relative to the encoder's full density, 0 ... 1."""
    weight: Float32[Tensor, "*b k 2 8 8 8"]
    """Square error of an image (mean over the figure, of encoded colours) per square error of the colour, and of the
    relative density, of this voxel."""
    extent: Float32[Tensor, "*b k 3"]
    """Delta scales of the boxes."""


def voxel_loss(payload: Payload, fitted: FittedVoxels, full_density: float) -> Tensor:
    """Weighted square distance of voxels, in the units of `rgb_loss`; mean over the batch.

    `fitted` must have the extents of the payload: see `resampled`.
    """
    colour, filling = (fitted.weight + UNSEEN).unbind(-4)
    colours = (colour[..., None, :, :, :] * (payload.rgb - fitted.rgb).square()).flatten(-5).sum(-1)
    densities = (filling * (payload.density / full_density - fitted.density).square()).flatten(-4).sum(-1)
    return RESIDUAL**2 * (colours + densities).mean()


def resampled(fitted: FittedVoxels, extent: Float32[Tensor, "k 3"]) -> FittedVoxels:
    """One subject's voxels in boxes of other thickness, linearly along N; empty beyond the fitted boxes.

    The hull that a few masks enclose differs from view to view, and boxes start as thick as the hull.
    """
    layer = torch.linspace(-1, 1, S) * (extent[:, 2] / fitted.extent[:, 2])[:, None]
    place = (layer.clamp(-1, 1) + 1) * (S - 1) / 2
    below = place.floor().clamp(max=S - 2).long()
    share, box = (place - below)[:, :, None, None], torch.arange(len(layer))[:, None]
    inside = (layer.abs() < 1 + 1 / (S - 1))[:, :, None, None]

    def along(values: Tensor) -> Tensor:
        return values[box, below] * (1 - share) + values[box, below + 1] * share

    return FittedVoxels(
        rgb=torch.stack([along(channel) for channel in fitted.rgb.unbind(1)], 1),
        density=along(fitted.density) * inside,
        weight=torch.stack([along(channel) for channel in fitted.weight.unbind(1)], 1),
        extent=extent,
    )


def fit_missing(captures: Captures, encoder: EncoderConfig, folder: Path) -> None:
    """Fit the voxels of all subjects that have no file in `folder`, or one of other images or boxes. A stop loses one.

    Raises:
        FileNotFoundError, FileError: an image is missing or damaged.
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sources = {name: _source(captures.subject(name), encoder) for name in captures.subjects}
    missing = [name for name, source in sources.items() if _stored_source(_path(folder, name)) != source]
    for number, name in enumerate(missing):
        began = time.perf_counter()
        write_fitted(folder, name, fit_subject(captures, name, encoder), sources[name])
        seconds = time.perf_counter() - began
        logging.info("fitted the voxels of %s, %d of %d, %.0f s", name, number + 1, len(missing), seconds)


def fit_subject(captures: Captures, name: str, encoder: EncoderConfig) -> FittedVoxels:
    """Fit one subject's voxels to at most MOST_IMAGES of its images, evenly spread over frames and cameras."""
    subject = captures.subject(name)
    betas = default_betas(subject)
    with torch.random.fork_rng():
        torch.manual_seed(0)  # weights that encode nothing yet: the start is the hull in the colours of the images
        untrained = EncoderModel(Encoder(encoder).eval().requires_grad_(False), {})
    first = conditioning_views(captures, name, 0, spread_cameras(subject, 0, START_VIEWS))
    start = untrained.encode(first, betas)
    shown = _spread(subject.frames * len(subject.views), MOST_IMAGES)
    targets: list[PosedView] = []
    for frame in range(subject.frames):
        cameras = [int(i) % len(subject.views) for i in shown if i // len(subject.views) == frame]
        if cameras:
            views = conditioning_views(captures, name, frame, cameras)
            frames = frames_of(encoder, betas, views.pose)[1]
            targets += targets_of(views, [frames] * len(cameras), SIDE)
    payload = fit_payload(start, targets, encoder.full_density, SETTINGS)
    few = [targets[int(i)] for i in _spread(len(targets), MOST_INFLUENCES)]
    weight = influence(payload, few, encoder.full_density, SETTINGS)
    return FittedVoxels(payload.rgb, payload.density / encoder.full_density, weight, payload.delta_scale)


def read_fitted(folder: Path, name: str) -> FittedVoxels:
    """Read a subject's voxels. Raises FileNotFoundError, or FileError for a damaged file."""
    path = _path(folder, name)
    arrays = read_arrays(path, ("rgb", "density", "weight", "extent"))
    shapes = {"rgb": (K, 3, S, S, S), "density": (K, S, S, S), "weight": (K, 2, S, S, S), "extent": (K, 3)}
    types = {"rgb": "uint16", "density": "uint16", "weight": "float32", "extent": "float32"}
    for key, array in arrays.items():
        if array.shape != shapes[key] or array.dtype != types[key] or not np.isfinite(array).all():
            raise FileError(path, f"has no {key} of fitted voxels", "delete it, it is made again")
    if not (arrays["extent"] > 0).all() or (arrays["weight"] < 0).any():
        raise FileError(path, "has boxes of no size or negative weights", "delete it, it is made again")
    return FittedVoxels(
        rgb=torch.from_numpy(arrays["rgb"].astype(np.float32) / STEPS),
        density=torch.from_numpy(arrays["density"].astype(np.float32) / STEPS),
        weight=torch.from_numpy(arrays["weight"]),
        extent=torch.from_numpy(arrays["extent"]),
    )


def write_fitted(folder: Path, name: str, fitted: FittedVoxels, source: str) -> None:
    """Write a subject's voxels, atomically, with what they were made from. Raises OSError."""
    arrays = {key: (getattr(fitted, key).numpy() * STEPS).round().astype(np.uint16) for key in ("rgb", "density")}
    with written_whole(_path(folder, name)) as unfinished:
        others = {"weight": fitted.weight.numpy(), "extent": fitted.extent.numpy(), "source": np.array(source)}
        write_deflated(unfinished, {**arrays, **others})


def _source(subject: Subject, encoder: EncoderConfig) -> str:
    """What voxels are made from: the images by name and size, and the settings that place boxes and look images up."""
    pictures = sorted(path for kind in ("img", "mask") for path in (subject.folder / kind).rglob("*.*"))
    images = [(path.relative_to(subject.folder).as_posix(), path.stat().st_size) for path in pictures]
    digest = hashlib.sha256(repr(images).encode()).hexdigest()
    return f"{digest} {[getattr(encoder, name) for name in PLACING]}"


def _stored_source(path: Path) -> str | None:
    """The source of a file; None if there is no file. Raises FileError for a damaged one."""
    return str(read_arrays(path, ("source",))["source"]) if path.exists() else None


def _path(folder: Path, name: str) -> Path:
    return folder / f"{name}.npz"


def _spread(count: int, most: int) -> np.ndarray:
    """At most `most` numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
