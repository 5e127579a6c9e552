"""What humans' boxes show from outside, as surfaces: drawn at once where a marched picture takes a while.

The GPU draws a whole picture of them in the time of one redraw, also without compute shaders.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import gpu
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..boxes import Boxes
from ..view import NO_SURFACE_M, PinholeView, opengl_projection
from .shaders import BOXES_A_ROW, VOXELS, cache_until_exit, shader_of

VISIBLE = 0.3
"""Opacity along a box's normal from which on its surface is drawn: neighbours overlap where each is fainter."""
_HALF = 0.5
_CELL = np.array([[0, 1, VOXELS], [1, VOXELS + 1, VOXELS]])
"""Corners of the two triangles of a cell, as steps in a grid [B, T] of voxels."""


@dataclasses.dataclass(frozen=True, eq=False)
class Relief:
    """A surface over each box: for each column of voxels along its normal, where that becomes opaque from outside."""

    place: NDArray[np.float32]
    """Vertices [N, 3] in their box: T, B, N in [-1, 1]."""
    tint: NDArray[np.float32]
    """Linear colour and opacity of the column [N, 4]; where the opacity is below VISIBLE there is nothing."""
    box: NDArray[np.float32]
    """Index of the vertex' box [N]."""
    triangles: NDArray[np.int32]
    """Vertices of each [M, 3]."""


def relief_of(rgb: NDArray, density: NDArray, thickness: NDArray) -> Relief:
    """The surface of boxes with linear `rgb` [K, 3, 8, 8, 8] and `density` [K, 8, 8, 8] in 1/m, axes N, B, T, each
    `thickness` [K] metres high along N.

    The opacity of a column is the sum of docs/design/marcher.md along N, with the window; its height is where half of
    it, at most one half, is above; its colour the mean of what a ray from outside sees.
    """
    centres = np.linspace(-1, 1, VOXELS, dtype=np.float32)
    window = np.exp(-8 * centres**8)
    weights = window[:, None, None] * window[:, None] * window
    step = np.asarray(thickness, np.float32)[:, None, None, None] / (VOXELS - 1)
    above = np.cumsum((density * weights * step)[:, ::-1], 1)
    opacity = above[:, -1]
    seen = np.diff(np.minimum(above, 1), axis=1, prepend=0)
    colour = np.einsum("knbt,kcnbt->kbtc", seen, rgb[:, :, ::-1]) / np.maximum(opacity.clip(0, 1), 1e-6)[..., None]
    tint = np.concatenate([colour, opacity.clip(0, 1)[..., None]], -1)
    height = _height(above, np.minimum(opacity, 1) * _HALF)
    across = np.broadcast_arrays(centres[None, None, :], centres[None, :, None], height)
    return _without_hidden(np.stack(across, -1), tint)


def _height(above: NDArray, wanted: NDArray) -> NDArray:
    """N in [-1, 1] where sums from outside [K, 8, 8, 8] reach what is wanted [K, 8, 8], between two voxels."""
    first = (above >= wanted[:, None]).argmax(1)[:, None]
    here = np.take_along_axis(above, first, 1)[:, 0]
    before = np.where(first > 0, np.take_along_axis(above, np.maximum(first - 1, 0), 1), 0)[:, 0]
    part = (wanted - before) / np.maximum(here - before, 1e-9)
    return np.clip(1 - 2 / (VOXELS - 1) * (first[:, 0] - 1 + part), -1, 1)


def _without_hidden(place: NDArray, tint: NDArray) -> Relief:
    """The cells of grids [K, 8, 8, ..] that are visible somewhere, and their vertices."""
    visible = tint[..., 3] >= VISIBLE
    cells = visible[:, :-1, :-1] | visible[:, :-1, 1:] | visible[:, 1:, :-1] | visible[:, 1:, 1:]
    box, b, t = np.nonzero(cells)
    corners = (((box * VOXELS + b) * VOXELS + t)[:, None, None] + _CELL).reshape(-1, 3)
    seen = np.zeros(tint[..., 3].size, np.bool_)
    seen[corners] = True
    used, triangles = np.flatnonzero(seen), (np.cumsum(seen) - 1)[corners]
    return Relief(
        place.reshape(-1, 3)[used].astype(np.float32),
        tint.reshape(-1, 4)[used].astype(np.float32),
        (used // VOXELS**2).astype(np.float32),
        triangles.reshape(-1, 3).astype(np.int32),
    )


_ROWS = 3
"""Texels of a box: the rows of its transform to the camera's coordinates."""
_VERTEX = f"""
void main()
{{
  int n = int(box);
  ivec2 first = ivec2((n % {BOXES_A_ROW}) * {_ROWS}, n / {BOXES_A_ROW});
  vec4 local = vec4(pos, 1.0);
  vec3 point = vec3(dot(texelFetch(places, first, 0), local), dot(texelFetch(places, first + ivec2(1, 0), 0), local),
                    dot(texelFetch(places, first + ivec2(2, 0), 0), local));
  colour = tint;
  metres = point.z - offset;
  gl_Position = projection * vec4(point, 1.0);
}}
"""
_FRAGMENT = f"""
void main()
{{
  if (colour.a < {VISIBLE} || (ended != 0 && metres > texelFetch(ends, ivec2(gl_FragCoord.xy), 0).x)) {{
    discard;
    return;
  }}
  picture = vec4(colour.rgb, 1.0);
  surface = metres;
}}
"""


class GpuRelief:
    """A human's relief on the GPU, 2 MB."""

    def __init__(self, relief: Relief):
        format_ = gpu.types.GPUVertFormat()
        columns = {"pos": (3, relief.place), "tint": (4, relief.tint), "box": (1, relief.box)}
        for name, (length, _) in columns.items():
            format_.attr_add(id=name, comp_type="F32", len=length, fetch_mode="FLOAT")
        vertices = gpu.types.GPUVertBuf(format_, max(len(relief.place), 1))
        for name, (_, values) in columns.items() if len(relief.place) else ():
            vertices.attr_fill(name, np.ascontiguousarray(values, np.float32))
        corners = gpu.types.GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(relief.triangles, np.int32))
        self.batch = gpu.types.GPUBatch(type="TRIS", buf=vertices, elem=corners)


class ReliefPicture:
    """A picture as `GpuMarch` makes it, drawn when it is made: `colour` is opaque where there is a surface."""

    def __init__(
        self,
        humans: Sequence[tuple[GpuRelief | None, Boxes]],
        view: PinholeView,
        ends: gpu.types.GPUTexture | None = None,
    ):
        """`ends` as for `GpuMarcher.march`. Raises RuntimeError where the shader does not compile."""
        size = (view.width, view.height)
        self.colour, self.depth = (gpu.types.GPUTexture(size, format=kind) for kind in ("RGBA16F", "R32F"))
        self.colour.clear(format="FLOAT", value=(0.0, 0.0, 0.0, 0.0))
        self.depth.clear(format="FLOAT", value=(NO_SURFACE_M,))
        nearest = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")  # the frame buffer does not keep it
        frame = gpu.types.GPUFrameBuffer(color_slots=(self.colour, self.depth), depth_slot=nearest)
        shader = relief_shader()
        projection = opengl_projection(dataclasses.replace(view, world_to_camera=np.eye(3, 4)))
        with frame.bind():
            frame.clear(depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("LESS_EQUAL")
            gpu.state.depth_mask_set(True)
            shader.bind()
            shader.uniform_float("projection", Matrix(projection.tolist()))
            shader.uniform_float("offset", view.depth_offset)
            shader.uniform_int("ended", int(ends is not None))
            for relief, boxes in humans:
                if relief is not None:
                    gpu.state.face_culling_set("FRONT" if np.linalg.det(boxes.rotation[0]) < 0 else "BACK")
                    places = _places(boxes, view)
                    shader.uniform_sampler("places", places)
                    shader.uniform_sampler("ends", ends or places)
                    relief.batch.draw(shader)
            gpu.state.face_culling_set("NONE")
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)

    def wait(self) -> None:
        """Return when the GPU has drawn it."""
        frame = gpu.types.GPUFrameBuffer(color_slots=self.colour)
        with frame.bind():
            frame.read_color(0, 0, 1, 1, 4, 0, "FLOAT")


def _places(boxes: Boxes, view: PinholeView) -> gpu.types.GPUTexture:
    """Transforms of boxes from [-1, 1] to the camera's coordinates, computed in float64."""
    turn, shift = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
    rows = np.zeros((-(-len(boxes.position) // BOXES_A_ROW) * BOXES_A_ROW, 3, 4), np.float32)
    found: NDArray = rows[: len(boxes.position)]
    found[:, :, :3] = turn @ (boxes.rotation * boxes.half_extent[:, None])
    found[:, :, 3] = boxes.position @ turn.T + shift
    size = (BOXES_A_ROW * _ROWS, len(rows) // BOXES_A_ROW)
    return gpu.types.GPUTexture(size, format="RGBA32F", data=gpu.types.Buffer("FLOAT", rows.size, rows.ravel()))


@cache_until_exit
def relief_shader() -> gpu.types.GPUShader:
    """Raises RuntimeError where it does not compile."""
    info, between = gpu.types.GPUShaderCreateInfo(), gpu.types.GPUStageInterfaceInfo("primdiffusion_relief")
    between.smooth("VEC4", "colour")
    between.smooth("FLOAT", "metres")
    info.vertex_in(0, "VEC3", "pos")
    info.vertex_in(1, "VEC4", "tint")
    info.vertex_in(2, "FLOAT", "box")
    info.vertex_out(between)
    info.sampler(0, "FLOAT_2D", "places")
    info.sampler(1, "FLOAT_2D", "ends")
    info.push_constant("MAT4", "projection")
    info.push_constant("FLOAT", "offset")
    info.push_constant("INT", "ended")
    info.fragment_out(0, "VEC4", "picture")
    info.fragment_out(1, "FLOAT", "surface")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return shader_of(info)
