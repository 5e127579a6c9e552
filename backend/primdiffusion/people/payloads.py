"""Write payload files: the training set of the diffusion model.

A file `person_NNNNNN.npz` contains one geometry in several colourings: `voxels` uint8 [variants, K, 8, 8, 8, 4] (axes
D, H, W; sRGB-encoded colour and density * 255 / full_density), `betas` [10], `attributes` (JSON: those of the first
colouring, and under "variants" those of each), `full_density` (1/m) and `seed`. Samples whose boxes differ from the
rest size also have `delta_scale` float16 [variants, K, 3]; those from meshes have `making`, their method and version;
those from captures have `source` (JSON: images and encoder) and may have no seed. Files are written atomically;
a second run skips complete ones.

Voxels with the colour of the nearest surface point (`from_mesh`) draw a blurred human, because about four boxes overlap
at every point. So the sum of the overlapping boxes is fitted to renders of the mesh.

Most of what pictures leave open, numbers that cancel between overlapping boxes, would be particular to each human, and
no network could learn it. So a fit starts from what a trained model makes of the mesh's own colours, and is pulled
towards that: similar humans get similar payloads. The next model is trained on these (expectation maximisation). All
samples use the same cameras, for the same reason.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn import functional

from primdiffusion.body.model import default_body
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.files.arrays import read_arrays, write_deflated
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.image import encode_srgb, to_bytes
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import Person, make_person, recolour
from primdiffusion.people.wardrobe import attribute_labels
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import FULL_DENSITY, colour, surface_field
from primdiffusion.primitives.primitives import Frames, K, Payload, S
from primdiffusion.primitives.skirts import box_sizes
from primdiffusion.raster.rasterise import rasterise_colourings
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import InverseSettings, fit_colours, fit_payload
from primdiffusion.runtime.worker_process import each

VARIANT_STRIDE = 1 << 32
"""Variant j of seed s is coloured with seed s + j * VARIANT_STRIDE."""
KEYS = ("voxels", "betas", "attributes", "full_density", "seed", "making")
METHOD = "fitted 6"
"""Method and version stored in files, followed by the checkpoint; those of others are made again."""
GUESS_LEVEL = 100
"""Step at which the model denoises the mesh's own colours, to make the start of a fit."""


def make_payloads(
    assets: Assets,
    out_dir: Path,
    count: int,
    variants: int,
    seed: int,
    workers: int,
    checkpoint: Path | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Write the missing files of seeds seed ... seed + count - 1 to `out_dir`; return the paths of all.

    A sample of four variants takes the better part of a minute on one core. Fits start from guesses of `checkpoint`
    (None: the included one). `report` receives the number of finished samples and the total.

    Raises:
        ValueError: a count is not positive; the checkpoint is damaged; a worker process was killed.
        FileNotFoundError, FileError: asset files are missing or damaged.
    """
    for name, value in (("count", count), ("variants", variants), ("workers", workers)):
        if value < 1:
            raise ValueError(f"{name} is {value}: give 1 or more")
    method = _method(checkpoint)
    out_dir.mkdir(parents=True, exist_ok=True)
    paths = [out_dir / f"person_{person_seed:06d}.npz" for person_seed in range(seed, seed + count)]
    jobs = [
        (path, person_seed)
        for path, person_seed in zip(paths, range(seed, seed + count), strict=True)
        if not is_complete(path, variants, person_seed, method)
    ]
    done = count - len(jobs)
    report(done, count)
    work = [(assets, path, variants, person_seed, checkpoint) for path, person_seed in jobs]
    for _ in each(write_payloads, work, workers):
        done += 1
        report(done, count)
    return paths


def write_payloads(assets: Assets, path: Path, variants: int, seed: int, checkpoint: Path | None) -> None:
    """Generate one sample in all colourings and write its file, atomically."""
    colourings = coloured_people(assets, seed, variants)
    person = colourings[0]
    meshes, frames = [variant.mesh for variant in colourings], rest_frames(person.betas)
    sizes = box_sizes(attribute_labels(person.attributes)["outfit"])
    payloads = fitted_payloads(meshes, frames, person.betas, _model(checkpoint), sizes)
    attributes = {**person.attributes, "variants": [variant.attributes for variant in colourings]}
    entries = {
        "voxels": np.stack([voxels_from_payload(payload) for payload in payloads]),
        "betas": person.betas,
        "attributes": json.dumps(attributes),
        "seed": seed,
        "making": _method(checkpoint),
    }
    if sizes is not None:
        entries["delta_scale"] = sizes.half().expand(variants, K, 3).numpy()
    store_payloads(path, entries)


@functools.lru_cache(maxsize=1)
def _model(checkpoint: Path | None) -> DiffusionModel:
    return load_checkpoint(checkpoint)


def _method(checkpoint: Path | None) -> str:
    """Method and version for a file, with the checkpoint."""
    return f"{METHOD} from {_model(checkpoint).card['sha256'][:12]}"


def coloured_people(assets: Assets, seed: int, variants: int) -> list[Person]:
    """A sample in `variants` colourings; the first is `make_person`'s."""
    person = make_person(assets, load_base_mesh(), seed)
    return [person, *(recolour(person, seed + number * VARIANT_STRIDE) for number in range(1, variants))]


def store_payloads(path: Path, entries: Mapping[str, np.ndarray | str | int]) -> None:
    """Write a payload file, atomically, with `full_density` added. Raises OSError, which names the file."""
    with atomic_path(path) as unfinished:
        write_deflated(
            unfinished, {key: np.asarray(value) for key, value in {**entries, "full_density": FULL_DENSITY}.items()}
        )


def rest_frames(betas: Float[np.ndarray, "10"]) -> Frames:
    """Frames of the default body's primitives in the rest pose."""
    body = default_body()
    vertices = body.shape(torch.as_tensor(betas, dtype=body.template.dtype)).vertices
    return attach(default_anchors(), vertices, body.faces)


def voxels_from_payload(payload: Payload) -> UInt8[np.ndarray, "K 8 8 8 4"]:
    """Quantise a payload to bytes: sRGB-encoded colour, and density with 255 for FULL_DENSITY."""
    encoded = encode_srgb(payload.rgb.clamp(0, 1)).movedim(1, -1)
    density = (payload.density / FULL_DENSITY).clamp(0, 1)[..., None]
    return to_bytes(torch.cat([encoded, density], dim=-1)).numpy()


def is_complete(path: Path, variants: int, seed: int, method: str) -> bool:
    """Whether a file contains this sample, made by this method; False for damaged files, which are made again."""
    try:
        arrays = read_arrays(path, KEYS)
        known = int(arrays["seed"]), str(arrays["making"])
    except (OSError, ValueError):
        return False
    return known == (seed, method) and arrays["voxels"].shape == (variants, K, S, S, S, 4)


BODY_VIEWS, BODY_SIZE, BODY_FOV = 28, 176, math.radians(30)
"""Full-body views: number, image size in pixels, field of view."""
HEAD_VIEWS, HEAD_SIZE, HEAD_FOV = 20, 144, math.radians(12)
"""Views of the head, denser from the front."""
HEAD_EXTENT, HEAD_BELOW_TOP = 0.42, 0.13
"""Extent of the head views, and depth of their centre below the top of the skull, metres."""
BODY_PITCHES = (0, 10, -10, 25, 5, -5, 15)
HEAD_PITCHES = (0, 10, -10, 20, -5)
"""Camera elevations in degrees, cycled over the views."""
SUPERSAMPLE = 3
SETTINGS = InverseSettings(pull=0.2)
"""Settings of fits that start from a model's guess: a strong pull keeps the guess where pictures say nothing."""


def fitted_payloads(
    colourings: Sequence[TexturedMesh],
    frames: Frames,
    betas: Float[ndarray, "10"],
    model: DiffusionModel | None,
    sizes: Float[Tensor, "k 3"] | None = None,
    settings: InverseSettings = SETTINGS,
    turn: float = 0.0,
) -> list[Payload]:
    """Fit payloads to meshes that differ only in their textures, in the rest pose of the default body.

    Density and the first colouring are fitted jointly, then all colours with that density fixed. Each starts from the
    guess of `model` (None: the mesh's own colours). `sizes` are the payloads' `delta_scale` (None: 1). `turn` (0 to 1)
    rotates the cameras towards their neighbours, to measure how much the result depends on them.

    Takes about 30 s on one core; further colourings add little, as they share marches and matrices.

    Raises:
        ValueError: as `surface_field`; no colourings are given.
    """
    if not colourings:
        raise ValueError("no mesh to fit to: give at least one colouring")
    sizes = torch.ones_like(frames.half_extent) if sizes is None else sizes
    field = surface_field(colourings[0], dataclasses.replace(frames, half_extent=frames.half_extent * sizes))
    starts = [dataclasses.replace(colour(field, mesh), delta_scale=sizes) for mesh in colourings]
    near = near_surface(starts[0])
    if model is not None:
        starts = [guess(model, start) for start in starts]
    targets = _targets(colourings, frames, betas, turn)
    fitted = fit_payload(starts[0], targets[0], FULL_DENSITY, settings)
    fitted = dataclasses.replace(fitted, density=fitted.density * near)
    return fit_colours([fitted, *starts[1:]], fitted, targets, settings)


def near_surface(payload: Payload) -> Bool[Tensor, "k 8 8 8"]:
    """Voxels of a mesh's own payload that are dense, and their neighbours.

    What a model guesses elsewhere, and pictures hardly see, is smoke beside long hair.
    """
    return functional.max_pool3d((payload.density[:, None] > 0).float(), 3, stride=1, padding=1)[:, 0] > 0


def guess(model: DiffusionModel, payload: Payload) -> Payload:
    """The payload as a model of the default body would draw it: denoised once from t = GUESS_LEVEL."""
    x = model.schedule.signal(GUESS_LEVEL) * model.encode(payload)
    decoded = model.decode(model.denoise(x[None], GUESS_LEVEL)[0])
    return Payload(decoded.rgb, decoded.density.clamp(max=FULL_DENSITY), payload.delta_scale)


def views_of(mesh: TexturedMesh, betas: Float[ndarray, "10"], turn: float = 0.0) -> list[tuple[Camera, float]]:
    """Cameras around the body and around the head, each with its weight; both groups have equal total weight."""
    views = []
    low, high = mesh.bounds
    extent = 1.1 * float((high - low).max())
    for number in range(BODY_VIEWS):
        yaw = 360 * (number + turn) / BODY_VIEWS
        pitch = BODY_PITCHES[number % len(BODY_PITCHES)]
        camera = orbit_camera((low + high) / 2, extent, yaw, pitch, BODY_FOV, BODY_SIZE)
        views.append((camera, 1 / BODY_VIEWS))
    for number in range(HEAD_VIEWS):
        side = 2 * (number + turn + 0.5) / HEAD_VIEWS - 1
        yaw = 180 * (0.45 * side + 0.55 * side**3)
        pitch = HEAD_PITCHES[number % len(HEAD_PITCHES)]
        camera = orbit_camera(head_centre(betas), HEAD_EXTENT, yaw, pitch, HEAD_FOV, HEAD_SIZE)
        views.append((camera, 1 / HEAD_VIEWS))
    return views


def head_centre(betas: Float[ndarray, "10"]) -> Float[ndarray, "3"]:
    """Centre of the head in the rest pose, between the eyes and the back of the skull, metres."""
    body = default_body()
    vertices = body.shape(torch.as_tensor(betas, dtype=body.template.dtype)).vertices.numpy()
    top = vertices[:, 1].max()
    head = vertices[vertices[:, 1] > top - 0.2]
    return np.array([head[:, 0].mean(), top - HEAD_BELOW_TOP, head[:, 2].mean()])


def orbit_camera(middle: Float[ndarray, "3"], extent: float, yaw: float, pitch: float, fov: float, size: int) -> Camera:
    """A square camera looking at `middle` from `yaw` and `pitch` degrees; its view spans `extent` metres there.

    Yaw 0 sees the front (+z), 90 the left side (+x).
    """
    distance = extent / 2 / math.tan(fov / 2)
    turned, lifted = math.radians(yaw), math.radians(pitch)
    way = np.array([math.sin(turned) * math.cos(lifted), math.sin(lifted), math.cos(turned) * math.cos(lifted)])
    position, target = (torch.from_numpy(np.asarray(point)).float() for point in (middle + distance * way, middle))
    return look_at(position, target, vertical_fov=fov, width=size, height=size)


def _targets(colourings: Sequence[TexturedMesh], frames: Frames, betas: ndarray, turn: float) -> list[list[PosedView]]:
    """Renders of each colouring, all from the same cameras."""
    targets: list[list[PosedView]] = [[] for _ in colourings]
    views = views_of(colourings[0], betas, turn)
    drawn = rasterise_colourings(colourings, [camera for camera, _ in views], SUPERSAMPLE)
    for (camera, weight), pictures in zip(views, drawn, strict=True):
        for own, picture in zip(targets, pictures, strict=True):
            rgba = np.concatenate([picture.rgb, picture.alpha[..., None]], axis=-1)
            own.append(PosedView(frames, camera, torch.from_numpy(rgba), weight))
    return targets
