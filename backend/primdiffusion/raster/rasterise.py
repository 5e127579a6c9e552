"""Pictures of textured meshes from cameras and orthographic views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.raster.shade import OrthographicView, draw, flatten, shade
from primdiffusion.raster.textures import gather_textures


def rasterise(mesh: TexturedMesh, view: Camera | OrthographicView, supersample: int = 1) -> Image:
    """Render the mesh from `view`, unlit and two-sided.

    `supersample` x `supersample` samples per pixel are averaged in linear light, which antialiases edges and textures.
    Depth is that of the pixel's nearest sample.
    Deterministic. Not differentiable.

    Raises:
        ValueError: see `flatten`; `supersample` is less than 1.
    """
    ((picture,),) = rasterise_colourings([mesh], [view], supersample)
    return picture


def rasterise_colourings(
    meshes: Sequence[TexturedMesh], views: Sequence[Camera | OrthographicView], supersample: int = 1
) -> Iterator[list[Image]]:
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
        depth = fragments.depth.reshape(view.height, supersample, view.width, supersample).min((1, 3))
        coloured = (shade(fragments, own, view.height, view.width) for own in textures)
        yield [Image(rgb, alpha, depth) for rgb, alpha in coloured]
