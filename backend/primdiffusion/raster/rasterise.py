"""Pictures of textured meshes: from cameras and orthographic views, and views of a posed human for captures.

Those of captures have several samples per pixel, textures, an alpha test, no light.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import numba
import numpy as np
from jaxtyping import Float, Float64, Int32, UInt8

from primdiffusion.body.model import J
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.shade import NEAR, OrthographicView, TriangleSoup, draw, flatten, shade
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
    """Same as `rasterise`, for each view: the images of meshes that differ only in the colours of their textures.

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


SAME_PLACE = 1e-6
"""Vertices of a part closer than this in the rest pose (metres) share a normal, so texture seams stay smooth."""
Draw = Callable[[View, int], Image]
"""Draws a posed human from a view with an odd number of samples along each side of a pixel; deterministic.

Colour and opacity are means over each pixel, the other passes samples at its centre. Raises ValueError for an even
number of samples, of which none is at the centre.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Figure:
    """A mesh prepared for rendering in many poses: what does not depend on the pose, all parts concatenated."""

    mesh: TexturedMesh
    """Mesh in the rest pose."""
    soup: TriangleSoup
    """Its triangles in the rest pose."""
    joint: UInt8[np.ndarray, "F"]
    """Joint with the largest weight at each face's corners."""
    corner: Int32[np.ndarray, "V"]
    """Index shared by coincident vertices of a part, over which normals are averaged."""

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> Draw:
        """Pose the figure by linear blend skinning, world <- rest."""
        vertices = self.points(skinning)
        return functools.partial(_draw, self, vertices, self._normals(vertices))

    def points(self, skinning: Float[np.ndarray, "J 4 4"]) -> Float64[np.ndarray, "V 3"]:
        """The vertices of all parts in a pose."""
        return np.concatenate([part.posed(skinning).vertices for part in self.mesh.parts])

    def _normals(self, vertices: np.ndarray) -> np.ndarray:
        """Area-weighted unit normals of vertices."""
        corners = vertices[self.soup.faces]
        doubled_area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        places = self.corner[self.soup.faces]
        total = np.stack(
            [
                np.bincount(places.ravel(), np.repeat(doubled_area[:, axis], 3), minlength=self.corner.max() + 1)
                for axis in range(3)
            ],
            -1,
        )
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
        return total[self.corner].astype(np.float32)


def figure_from_mesh(mesh: TexturedMesh) -> Figure:
    """Prepare a mesh for posing and drawing.

    Raises:
        ValueError: as `flatten`.
    """
    first = 0
    corners = []
    for part in mesh.parts:
        places = np.round(part.vertices / SAME_PLACE).astype(np.int64)
        _, corner = np.unique(places, axis=0, return_inverse=True)
        corners.append(corner.reshape(-1) + first)
        first += len(part.vertices)
    return Figure(
        mesh=mesh,
        soup=flatten(mesh),
        joint=np.concatenate([_joints_of_faces(part) for part in mesh.parts]),
        corner=np.concatenate(corners).astype(np.int32),
    )


def _joints_of_faces(part: TexturedPart) -> UInt8[np.ndarray, "F"]:
    sums = np.zeros((len(part.faces), J))
    rows = np.arange(len(part.faces))[:, None]
    for corner in part.faces.T:
        np.add.at(sums, (rows, part.skin_index[corner]), part.skin_weight[corner])
    return sums.argmax(1).astype(np.uint8)


def check_samples(samples: int) -> None:
    """Raise ValueError unless `samples` is odd and positive, so that one sample is at the pixel's centre."""
    if samples < 1 or samples % 2 == 0:
        raise ValueError(f"samples is {samples}: give an odd number, 1, 3, 5, ...")


def _draw(figure: Figure, vertices: np.ndarray, normals: np.ndarray, view: View, samples: int) -> Image:
    """Draw the figure with these vertices (metres) and unit normals, which point out from the front of faces."""
    check_samples(samples)
    size = (view.height, view.width)
    normal, part = np.zeros((*size, 3), np.float32), np.zeros(size, np.uint8)
    image = dataclasses.replace(Image.blank(view.width, view.height), normal=normal, part=part)
    left, top, right, bottom = _extent(vertices @ view.rotation.T + view.translation, view)
    if left >= right or top >= bottom:
        return image
    soup = dataclasses.replace(figure.soup, vertices=vertices)
    fragments = draw(soup, view, samples, (left, top, right, bottom))
    _look_up(
        fragments.face, fragments.depth, samples, left, top, fragments.edges, soup.faces, figure.joint, normals,
        vertices, view.position, image.depth, normal, part,
    )  # fmt: skip
    rgb, alpha = shade(fragments, soup.textures, *size)
    return dataclasses.replace(image, rgb=rgb, alpha=alpha)


def _extent(in_camera: np.ndarray, view: View) -> tuple[int, int, int, int]:
    """Bounds of the visible pixels: left, top, right and bottom, the last two exclusive."""
    if in_camera[:, 2].max() < NEAR:
        return 0, 0, 0, 0
    if in_camera[:, 2].min() < NEAR:
        return 0, 0, view.width, view.height
    homogeneous = in_camera @ view.intrinsics.T
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    low = np.floor(np.maximum(pixels.min(0), 0)).astype(int)
    high = np.ceil(np.minimum(pixels.max(0), (view.width, view.height))).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(
    face, distance, samples, left, top, edges, faces, joint, normals, vertices, eye, depth, normal, part
):  # fmt: skip
    direction = np.zeros(3)
    for pixel_row in range(face.shape[0] // samples):
        row = pixel_row * samples + samples // 2
        for pixel in range(face.shape[1] // samples):
            column = pixel * samples + samples // 2
            f = face[row, column]
            if f < 0:
                continue
            depth[top + pixel_row, left + pixel] = distance[row, column]
            part[top + pixel_row, left + pixel] = 1 + joint[f]
            towards, length = 0.0, 0.0
            direction[:] = 0
            for c in range(3):
                weight = edges[f, c, 0] * (column + 0.5) + (edges[f, c, 1] * (row + 0.5) + edges[f, c, 2])
                for axis in range(3):
                    direction[axis] += weight * normals[faces[f, c], axis]
            for axis in range(3):
                towards += direction[axis] * (eye[axis] - vertices[faces[f, 0], axis])
                length += direction[axis] * direction[axis]
            scale = (1.0 if towards >= 0 else -1.0) / max(np.sqrt(length), 1e-30)
            for axis in range(3):
                normal[top + pixel_row, left + pixel, axis] = direction[axis] * scale
