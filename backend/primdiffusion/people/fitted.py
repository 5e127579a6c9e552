"""Payloads of a person that show in pictures what the mesh shows: `from_mesh`, then fitted to renders of the mesh.

A voxel of `from_mesh` takes the colour of the nearest surface point, which blurs where boxes overlap: the marcher mixes
some four of them at every point. Fitting lets them share the work. Cameras are the same for everybody, so the same
person gives the same payload and similar people similar ones, which a network can learn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from primdiffusion.body.model import default_body
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.primitives.from_mesh import FULL_DENSITY, colour, surface_field
from primdiffusion.primitives.primitives import Frames, Payload
from primdiffusion.raster.rasterise import rasterise_colourings
from primdiffusion.render.inverse import InverseSettings, Target, fit_colours, fit_payload

BODY_VIEWS, BODY_SIZE, BODY_FOV = 28, 176, math.radians(30)
"""Pictures of the whole figure, their pixels a side, their field of view."""
HEAD_VIEWS, HEAD_SIZE, HEAD_FOV = 20, 144, math.radians(12)
"""Pictures of the head, denser from the front."""
HEAD_EXTENT, HEAD_BELOW_TOP = 0.42, 0.13
"""Metres: side of the picture at the head, and how far below the top of the skull its middle is."""
BODY_PITCHES = (0, 10, -10, 25, 5, -5, 15)
HEAD_PITCHES = (0, 10, -10, 20, -5)
"""Degrees above the horizon, view after view."""
SUPERSAMPLE = 3
SETTINGS = InverseSettings()


def fitted_payloads(
    colourings: Sequence[TexturedMesh],
    frames: Frames,
    betas: Float[ndarray, "10"],
    settings: InverseSettings = SETTINGS,
    turn: float = 0.0,
) -> list[Payload]:
    """The payloads of meshes that differ only in their textures, in the rest pose of the default body.

    Density and the first colouring are fitted together, then the colours of all on that density. `turn` (0 to 1) moves
    the cameras on towards their neighbours, to see how much of the result the cameras decide.

    Takes about 20 s of one core for the first colouring and 3 s for each further one.

    Raises:
        UnusableMesh, ValueError: as `surface_field`; there are no colourings.
    """
    if not colourings:
        raise ValueError("there is no mesh to fit to: give at least one colouring")
    field = surface_field(colourings[0], frames)
    starts = [colour(field, mesh) for mesh in colourings]
    targets = _targets(colourings, frames, betas, turn)
    fitted = fit_payload(starts[0], targets[0], FULL_DENSITY, settings)
    return fit_colours([fitted, *starts[1:]], fitted, targets, settings)


def views_of(mesh: TexturedMesh, betas: Float[ndarray, "10"], turn: float = 0.0) -> list[tuple[Camera, float]]:
    """Cameras around the figure and around its head, each with its weight: both groups count the same."""
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
    """The middle of the head in the rest pose, metres: between the eyes and the back of the skull."""
    body = default_body()
    vertices = body.shape(torch.as_tensor(betas, dtype=body.template.dtype)).vertices.numpy()
    top = vertices[:, 1].max()
    head = vertices[vertices[:, 1] > top - 0.2]
    return np.array([head[:, 0].mean(), top - HEAD_BELOW_TOP, head[:, 2].mean()])


def orbit_camera(middle: Float[ndarray, "3"], extent: float, yaw: float, pitch: float, fov: float, size: int) -> Camera:
    """A square camera that looks at `middle` from `yaw` and `pitch` degrees; `extent` metres there fill its picture.

    Yaw 0 sees the front (+z), 90 the left side (+x).
    """
    distance = extent / 2 / math.tan(fov / 2)
    turned, lifted = math.radians(yaw), math.radians(pitch)
    way = np.array([math.sin(turned) * math.cos(lifted), math.sin(lifted), math.cos(turned) * math.cos(lifted)])
    position, target = (torch.from_numpy(np.asarray(point)).float() for point in (middle + distance * way, middle))
    return look_at(position, target, vertical_fov=fov, width=size, height=size)


def _targets(colourings: Sequence[TexturedMesh], frames: Frames, betas: ndarray, turn: float) -> list[list[Target]]:
    """The pictures of each colouring, all from the same cameras."""
    targets: list[list[Target]] = [[] for _ in colourings]
    for camera, weight in views_of(colourings[0], betas, turn):
        for own, picture in zip(targets, rasterise_colourings(colourings, camera, SUPERSAMPLE), strict=True):
            rgba = np.concatenate([picture.rgb, picture.alpha[..., None]], axis=-1)
            own.append(Target(frames, camera, rgba, weight))
    return targets
