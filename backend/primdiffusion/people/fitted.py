"""Fit payloads to renders of a textured mesh, starting from `from_mesh`.

`from_mesh` gives each voxel the colour of the nearest surface point, which blurs because about four boxes overlap at
every point. Fitting optimises the sum of the overlapping boxes instead. All samples use the same cameras, so that
similar humans get similar payloads, which a network can learn.
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
"""Full-body views: number, image size in pixels, field of view."""
HEAD_VIEWS, HEAD_SIZE, HEAD_FOV = 20, 144, math.radians(12)
"""Views of the head, denser from the front."""
HEAD_EXTENT, HEAD_BELOW_TOP = 0.42, 0.13
"""Extent of the head views, and depth of their centre below the top of the skull, metres."""
BODY_PITCHES = (0, 10, -10, 25, 5, -5, 15)
HEAD_PITCHES = (0, 10, -10, 20, -5)
"""Camera elevations in degrees, cycled over the views."""
SUPERSAMPLE = 3
SETTINGS = InverseSettings()


def fitted_payloads(
    colourings: Sequence[TexturedMesh],
    frames: Frames,
    betas: Float[ndarray, "10"],
    settings: InverseSettings = SETTINGS,
    turn: float = 0.0,
) -> list[Payload]:
    """Fit payloads to meshes that differ only in their textures, in the rest pose of the default body.

    Density and the first colouring are fitted jointly, then all colours with that density fixed. `turn` (0 to 1)
    rotates the cameras towards their neighbours, to measure how much the result depends on them.

    Takes about 30 s on one core; further colourings add little, as they share marches and matrices.

    Raises:
        UnusableMesh, ValueError: as `surface_field`; no colourings are given.
    """
    if not colourings:
        raise ValueError("no mesh to fit to: give at least one colouring")
    field = surface_field(colourings[0], frames)
    starts = [colour(field, mesh) for mesh in colourings]
    targets = _targets(colourings, frames, betas, turn)
    fitted = fit_payload(starts[0], targets[0], FULL_DENSITY, settings)
    return fit_colours([fitted, *starts[1:]], fitted, targets, settings)


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


def _targets(colourings: Sequence[TexturedMesh], frames: Frames, betas: ndarray, turn: float) -> list[list[Target]]:
    """Renders of each colouring, all from the same cameras."""
    targets: list[list[Target]] = [[] for _ in colourings]
    for camera, weight in views_of(colourings[0], betas, turn):
        for own, picture in zip(targets, rasterise_colourings(colourings, camera, SUPERSAMPLE), strict=True):
            rgba = np.concatenate([picture.rgb, picture.alpha[..., None]], axis=-1)
            own.append(Target(frames, camera, rgba, weight))
    return targets
