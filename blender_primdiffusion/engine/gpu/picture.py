"""Whole pictures on the GPU for the engine's viewport: humans, solid objects and the background in linear colours.

As the backend's `drawing.compositing` where one surface covers a pixel: the rays through humans end at solids, and what
humans let through shows the solid or the background. Outlines are antialiased by averaging pictures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import gpu
import numpy as np
from mathutils import Matrix

from ..boxes import Boxes
from ..picture import SceneSolids
from ..view import NO_SURFACE_M, PinholeView, opengl_projection
from .march import GpuMarcher, GpuPayload
from .shaders import TILE, cache_until_exit, compiled, shader_of

_VERTEX = """
void main()
{
  world = pos;
  colour = tint;
  normal = upright;
  depth = dot(axis.xyz, pos) + axis.w;
  gl_Position = projection * vec4(pos, 1.0);
}
"""
_FRAGMENT = """
void main()
{
  /* The light of the backend's `shade_solids`: a sky and a headlight; holdouts are black and clear. */
  vec3 ray = world - eye;
  float facing = dot(normal, ray) / length(ray);
  float up = facing > 0.0 ? -normal.y : normal.y;
  picture = vec4(colour.rgb * (0.225 * (1.0 + up) + 0.55 * abs(facing)), 1.0) * colour.a;
  surface = depth;
}
"""
_COMPOSE = """
void main()
{
  ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
  if (pixel.x >= size.x || pixel.y >= size.y) {
    return;
  }
  vec4 human = texelFetch(humans, pixel, 0);
  vec4 behind = background;
  if (size.z != 0 && texelFetch(ends, pixel, 0).x < 1e9) {
    behind = texelFetch(solids, pixel, 0);
  }
  vec4 light = human + (1.0 - human.a) * behind;
  if (size.w > 0) {
    light = mix(texelFetch(before, pixel, 0), light, 1.0 / float(size.w + 1));
  }
  imageStore(composed, pixel, light);
}
"""


class GpuSolids:
    """Triangles on the GPU."""

    def __init__(self, solids: SceneSolids):
        tint = np.concatenate([solids.colour, 1.0 - solids.holdout[:, None]], 1)
        one, two = (solids.corners[:, i].astype(np.float64) - solids.corners[:, 0] for i in (1, 2))
        normal = np.cross(one, two)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        columns = {"pos": solids.corners.reshape(-1, 3), "tint": tint.repeat(3, 0), "upright": normal.repeat(3, 0)}
        format_ = gpu.types.GPUVertFormat()
        for name, values in columns.items():
            format_.attr_add(id=name, comp_type="F32", len=values.shape[1], fetch_mode="FLOAT")
        vertices = gpu.types.GPUVertBuf(format_, 3 * len(solids.corners))
        for name, values in columns.items():
            vertices.attr_fill(name, np.ascontiguousarray(values, np.float32))
        self._batch = gpu.types.GPUBatch(type="TRIS", buf=vertices)

    def draw(self, view: PinholeView) -> tuple[gpu.types.GPUTexture, gpu.types.GPUTexture]:
        """Colour (RGBA16F, linear) and depth (R32F) as in `GpuMarch`."""
        size = (view.width, view.height)
        colour, ends = gpu.types.GPUTexture(size, format="RGBA16F"), gpu.types.GPUTexture(size, format="R32F")
        depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")  # the frame buffer does not keep it
        frame = gpu.types.GPUFrameBuffer(color_slots=(colour, ends), depth_slot=depth)
        colour.clear(format="FLOAT", value=(0.0, 0.0, 0.0, 0.0))
        ends.clear(format="FLOAT", value=(NO_SURFACE_M,))
        turn, shift = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
        shader = _solids_shader()
        with frame.bind():
            frame.clear(depth=1.0)
            gpu.state.blend_set("NONE")
            gpu.state.depth_test_set("LESS_EQUAL")
            gpu.state.depth_mask_set(True)
            shader.bind()
            shader.uniform_float("projection", Matrix(opengl_projection(view).tolist()))
            shader.uniform_float("axis", (*turn[2], shift[2] - view.depth_offset))
            shader.uniform_float("eye", -turn.T @ shift)
            self._batch.draw(shader)
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
        return colour, ends


@dataclasses.dataclass(frozen=True, eq=False)
class GpuScene:
    """What a picture shows."""

    humans: Sequence[tuple[GpuPayload, Boxes]]
    solids: GpuSolids | None
    background: tuple[float, float, float] | None
    """Linear; None for a transparent film."""
    step: float


class GpuPicture:
    """A picture that is drawn in slices; `compose` it when `advance` has returned True."""

    def __init__(self, marcher: GpuMarcher, scene: GpuScene, view: PinholeView, coarseness: int = 1):
        """Steps along rays are `coarseness` times as long as the scene's."""
        self._size = (view.width, view.height)
        self._background = (0.0, 0.0, 0.0, 0.0) if scene.background is None else (*scene.background, 1.0)
        self._solids = None if scene.solids is None else scene.solids.draw(view)
        ends = None if self._solids is None else self._solids[1]
        self.humans = marcher.march(scene.humans, view, scene.step * coarseness, ends)
        """The humans alone."""

    def advance(self, work: float = np.inf) -> bool:
        """As `GpuMarch.advance`."""
        return self.humans.advance(work)

    def wait(self) -> None:
        """As `GpuMarch.wait`."""
        self.humans.wait()

    def compose(self, before: gpu.types.GPUTexture | None = None, averaged: int = 0) -> gpu.types.GPUTexture:
        """The picture, RGBA16F, linear and premultiplied; the mean with `before`, the mean of `averaged` ones."""
        composed = gpu.types.GPUTexture(self._size, format="RGBA16F")
        solids, ends = self._solids or (self.humans.colour, self.humans.depth)
        shader = _compose_shader()
        shader.bind()
        textures = {"humans": self.humans.colour, "solids": solids, "ends": ends, "before": before or solids}
        for name, texture in textures.items():
            shader.uniform_sampler(name, texture)
        shader.image("composed", composed)
        shader.uniform_float("background", self._background)
        shader.uniform_int("size", (*self._size, int(self._solids is not None), averaged if before else 0))
        gpu.compute.dispatch(shader, *(-(-side // TILE) for side in self._size), 1)
        return composed


@cache_until_exit
def _solids_shader() -> gpu.types.GPUShader:
    info, between = gpu.types.GPUShaderCreateInfo(), gpu.types.GPUStageInterfaceInfo("primdiffusion_solids")
    between.smooth("VEC3", "world")
    between.flat("VEC4", "colour")
    between.flat("VEC3", "normal")
    between.smooth("FLOAT", "depth")
    info.vertex_in(0, "VEC3", "pos")
    info.vertex_in(1, "VEC4", "tint")
    info.vertex_in(2, "VEC3", "upright")
    info.vertex_out(between)
    info.push_constant("MAT4", "projection")
    info.push_constant("VEC4", "axis")
    info.push_constant("VEC3", "eye")
    info.fragment_out(0, "VEC4", "picture")
    info.fragment_out(1, "FLOAT", "surface")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return shader_of(info)


@cache_until_exit
def _compose_shader() -> gpu.types.GPUShader:
    info = gpu.types.GPUShaderCreateInfo()
    for slot, name in enumerate(("humans", "solids", "ends", "before")):
        info.sampler(slot, "FLOAT_2D", name)
    info.image(0, "RGBA16F", "FLOAT_2D", "composed", qualifiers={"WRITE"})
    info.push_constant("VEC4", "background")
    info.push_constant("IVEC4", "size")
    return compiled(info, _COMPOSE, (TILE, TILE))
