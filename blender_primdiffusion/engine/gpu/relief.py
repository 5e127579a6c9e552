"""Reliefs on the GPU: a whole picture of humans in the time of one redraw, also without compute shaders."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import gpu
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..boxes import Boxes
from ..relief import VISIBLE, Relief
from ..view import NO_SURFACE_M, PinholeView, opengl_projection
from .caching import cache_until_exit
from .shaders import BOXES_A_ROW, shader_of

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
