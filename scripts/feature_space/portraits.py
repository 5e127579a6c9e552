"""Portraits of stored payloads and of meshes, cached in a folder, and of generated samples: all in T pose, seen by the
same cameras."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from primdiffusion.files.arrays import read_arrays
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.image import encode_srgb, to_bytes
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.people.assets import Assets
from primdiffusion.people.payloads import coloured_people, rest_frames
from primdiffusion.people.stored_people import read_outline, read_payloads
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.rasterise import rasterise_colourings
from primdiffusion.render.march import MarchSettings, march
from torch import Tensor

SIDE = 256
"""Width and height of a portrait, pixels: enough to see whether a face is sharp."""
SETTINGS = MarchSettings(step=0.008)
"""8 mm between samples: in full-body views a pixel is 8 mm wide."""
SUPERSAMPLE = 3
"""Samples along a pixel's side in portraits of meshes."""
DISTANCE = 10.0
"""Metres from camera to human: large, so that perspective is weak."""


@dataclasses.dataclass(frozen=True)
class Portrait:
    """One view; the default body's pelvis is at the origin."""

    name: str
    yaw: float
    """As in `human.framing`: 0 looks at the face, pi/2 at the left side."""
    middle: float
    """Height of the image centre above the pelvis, metres."""
    height: float
    """Height of the view, metres."""


PORTRAITS = (
    Portrait("front", 0.0, -0.3, 2.16),
    Portrait("back", math.pi, -0.3, 2.16),
    Portrait("left", math.pi / 2, -0.3, 2.16),
    Portrait("head", 0.0, 0.48, 0.6),
)


def camera_of(portrait: Portrait, side: int = SIDE) -> Camera:
    """The camera of a view."""
    middle = torch.tensor([0.0, portrait.middle, 0.0])
    towards = torch.tensor([math.sin(portrait.yaw), 0.0, math.cos(portrait.yaw)])
    fov = 2 * math.atan(portrait.height / 2 / DISTANCE)
    return look_at(middle + DISTANCE * towards, middle, vertical_fov=fov, width=side, height=side)


def portraits(primitives: Primitives) -> UInt8[Tensor, "v h w 4"]:
    """All views drawn by the marcher: sRGB-encoded colour over black, and alpha."""
    seen = [march(primitives, camera_of(portrait), SETTINGS) for portrait in PORTRAITS]
    return torch.stack([_stored(one.rgb, one.alpha) for one in seen])


def mesh_portraits(colourings: Sequence[TexturedMesh]) -> UInt8[Tensor, "n v h w 4"]:
    """Portraits of meshes in T pose that differ only in their textures, as `portraits` of boxes."""
    seen = rasterise_colourings(colourings, [camera_of(portrait) for portrait in PORTRAITS], SUPERSAMPLE)
    views = [[_stored(torch.from_numpy(one.rgb), torch.from_numpy(one.alpha)) for one in images] for images in seen]
    return torch.stack([torch.stack(own) for own in zip(*views, strict=True)])


def _stored(rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w 4"]:
    return to_bytes(torch.cat([encode_srgb(rgb.clamp(0, 1)), alpha[..., None]], -1))


Report = Callable[[int, int], object]
"""Progress callback: done, total."""


COLOURINGS = 2
"""Colourings of each mesh in a gallery."""


def silent(done: int, total: int) -> None:
    """Ignore progress."""


@dataclasses.dataclass(frozen=True)
class Gallery:
    """Portraits of n samples of g geometries."""

    pictures: UInt8[Tensor, "n v h w 4"]
    geometry: Int[Tensor, "n"]
    """Index of each sample's file; ascending."""
    attributes: tuple[dict[str, Any], ...]


@dataclasses.dataclass(frozen=True)
class Source:
    """One geometry in n colourings to make portraits of."""

    name: str
    """Name of the file in the cache."""
    draw: Callable[[], UInt8[Tensor, "n v h w 4"]]
    attributes: Callable[[], list[dict[str, Any]]]
    """Reads the attributes of each colouring."""


def payload_sources(paths: Sequence[Path]) -> list[Source]:
    """Payload files, drawn by the marcher."""

    def draw(path: Path) -> UInt8[Tensor, "n v h w 4"]:
        person = read_payloads(path)
        frames = rest_frames(person.betas.numpy())
        return torch.stack(
            [portraits(Primitives.place(frames, person.payload(number))) for number in range(len(person.voxels))]
        )

    return [
        Source(path.name, lambda path=path: draw(path), lambda path=path: read_outline(path).colourings())
        for path in paths
    ]


def mesh_sources(assets: Assets, seeds: Sequence[int], colourings: int) -> list[Source]:
    """Meshes of MakeHuman samples, rasterised: what payloads of these seeds are made from."""
    people = functools.lru_cache(maxsize=1)(lambda seed: coloured_people(assets, seed, colourings))
    return [
        Source(
            f"mesh_{seed:08d}.npz",
            lambda seed=seed: mesh_portraits([person.mesh for person in people(seed)]),
            lambda seed=seed: [dict(person.attributes) for person in people(seed)],
        )
        for seed in seeds
    ]


def open_gallery(sources: Sequence[Source], folder: Path, report: Report = silent) -> Gallery:
    """Portraits of all sources; cached in `folder`, drawn where they are missing or damaged."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures, attributes = [], []
    for number, source in enumerate(sources):
        path = folder / source.name
        cached = _cached(path) if path.is_file() else None
        if cached is None:
            cached = source.draw(), source.attributes()
            with atomic_path(path) as unfinished, unfinished.open("wb") as file:
                np.savez_compressed(file, pictures=cached[0].numpy(), attributes=json.dumps(cached[1]))
        pictures.append(cached[0])
        attributes += cached[1]
        report(number + 1, len(sources))
    counts = torch.tensor([len(one) for one in pictures])
    return Gallery(torch.cat(pictures), torch.arange(len(sources)).repeat_interleave(counts), tuple(attributes))


def _cached(path: Path) -> tuple[Tensor, list[dict[str, Any]]] | None:
    """Pictures and attributes from an earlier run; None if they are damaged or of other views."""
    try:
        arrays = read_arrays(path, ("pictures", "attributes"))
        pictures, attributes = torch.from_numpy(arrays["pictures"]), parse_json(str(arrays["attributes"]))
    except ValueError:
        return None
    fits = tuple(pictures.shape[1:]) == (len(PORTRAITS), SIDE, SIDE, 4) and len(attributes) == len(pictures)
    return (pictures, attributes) if fits else None


def read_seed(path: Path) -> int:
    """Seed of the MakeHuman sample in a payload file. Raises ValueError for other samples and unreadable files."""
    return int(read_arrays(path, ("seed",))["seed"])


def made_gallery(samples: Iterable[Primitives]) -> UInt8[Tensor, "n v h w 4"]:
    """Portraits of generated samples; the iterable is consumed one by one."""
    return torch.stack([portraits(primitives) for primitives in samples])
