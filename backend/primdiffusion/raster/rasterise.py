"""Pictures of textured meshes from cameras and orthographic views."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float32

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.raster.shade import OrthographicView, camera_matrices, draw, flatten, shade
from primdiffusion.raster.textures import gather_textures


@dataclasses.dataclass(frozen=True, eq=False)
class RasterImage:
    """A rasterised mesh on black."""

    rgb: Float32[np.ndarray, "H W 3"]
    """Linear, premultiplied by `alpha`."""
    alpha: Float32[np.ndarray, "H W"]
    """Share of the pixel's samples that hit the mesh; 0 or 1 without supersampling."""
    depth: Float32[np.ndarray, "H W"]
    """Metres along the pixel's ray to the nearest sample; inf where alpha is 0."""


def rasterise(mesh: TexturedMesh, view: Camera | OrthographicView, supersample: int = 1) -> RasterImage:
    """Render the mesh from `view`, unlit and two-sided.

    `supersample` x `supersample` samples per pixel are averaged in linear light, which antialiases edges and textures.
    Deterministic. Not differentiable.

    Raises:
        ValueError: see `flatten`; `supersample` is less than 1.
    """
    ((picture,),) = rasterise_colourings([mesh], [view], supersample)
    return picture


def rasterise_colourings(
    meshes: Sequence[TexturedMesh], views: Sequence[Camera | OrthographicView], supersample: int = 1
) -> Iterator[list[RasterImage]]:
    """As `rasterise`, for each view: the images of meshes that differ only in the colours of their textures.

    Triangles are drawn once for a view, and textures gathered once.

    Raises:
        ValueError: see `flatten`; `supersample` is less than 1.
    """
    if supersample < 1:
        raise ValueError(f"supersample is {supersample}: give 1 or more")
    soup = flatten(meshes[0])
    textures = [soup.textures, *(gather_textures(mesh) for mesh in meshes[1:])]
    for view in views:
        fragments = draw(soup, view, supersample)
        distance = fragments.depth * _ray_lengths(view, supersample)
        depth = distance.reshape(view.height, supersample, view.width, supersample).min((1, 3))
        coloured = (shade(fragments, own, view.height, view.width) for own in textures)
        yield [RasterImage(rgb, alpha, depth) for rgb, alpha in coloured]


def _ray_lengths(view: Camera | OrthographicView, supersample: int) -> Float32[np.ndarray, "H W"] | np.float32:
    """Distance along the ray of each sample per metre along the optical axis."""
    if isinstance(view, OrthographicView):
        return np.float32(1)
    k, _, _ = camera_matrices(view)
    y = ((np.arange(view.height * supersample)[:, None] + 0.5) / supersample - k[1, 2]) / k[1, 1]
    x = ((np.arange(view.width * supersample) + 0.5) / supersample - k[0, 2] - k[0, 1] * y) / k[0, 0]
    return np.sqrt(1 + x * x + y * y).astype(np.float32)
