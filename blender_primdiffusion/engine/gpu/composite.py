"""Draws a marched picture into a 3D view: behind and before its objects, and beneath bones that are shown in front."""

from __future__ import annotations

import dataclasses

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from .march import GpuMarch
from .shaders import cache_until_exit

_NOTHING = "1e9"
"""Depths beyond are pixels without a surface."""
Part = tuple[float, float, float, float]
"""Left, bottom, right and top of a part of the region, as fractions of it."""
WHOLE: Part = (0.0, 0.0, 1.0, 1.0)
_CORNERS = 10
"""Corners of the polygon drawn for a joint."""

_VERTEX = """
void main()
{
  uv = pos * 0.5 + 0.5;
  gl_Position = vec4(pos, -1.0, 1.0);
}
"""

_FRAGMENT = f"""
void main()
{{
  vec4 light = texture(colour, uv);
  if (light.a < 0.002) {{
    discard;
    return;
  }}
  /* The faint rim has no surface of its own: it is as far as what it surrounds. */
  ivec2 last = textureSize(depth, 0) - 1;
  ivec2 at = ivec2(uv * vec2(last + 1));
  float metres = texelFetch(depth, clamp(at, ivec2(0), last), 0).x;
  if (metres > {_NOTHING}) {{
    for (int i = 0; i < 9; i++) {{
      metres = min(metres, texelFetch(depth, clamp(at + ivec2(i % 3, i / 3) - 1, ivec2(0), last), 0).x);
    }}
  }}
  float far = 1.0;
  if (metres < {_NOTHING}) {{
    float w = metres * lens.z + 1.0 - lens.z;
    far = clamp((lens.y - lens.x * metres) / w * 0.5 + 0.5, 0.0, 1.0);
  }}
  bool outside = any(lessThan(uv, frame.xy)) || any(greaterThan(uv, frame.zw));
  light.rgb *= outside ? 1.0 - lens.w : 1.0;
  gl_FragDepth = xray != 0 ? 1e-6 : far;
  picture = erases != 0 ? vec4(1.0 - light.a) : light * opacity;
}}
"""


@dataclasses.dataclass(frozen=True)
class ViewLook:
    """How a 3D view shows humans."""

    window_matrix: NDArray[np.float64]
    """[4, 4], OpenGL's projection."""
    opacity: float = 1.0
    xray: bool = False
    """Objects do not hide humans."""
    frame: Part = WHOLE
    """The camera's picture."""
    darkening: float = 0.0
    """Outside of the frame."""
    erases: bool = False
    """Humans are below already: only what is drawn above them and is farther goes, as far as they are opaque."""


def draw_picture(picture: GpuMarch, look: ViewLook, part: Part = WHOLE) -> None:
    """Draw a picture of the whole region, or a part of it, over the region, for handlers of the kind POST_VIEW.

    Blender's overlays are drawn before: their depth is in the buffer, but for those of objects in front. What is drawn
    here is encoded as sRGB, without the scene's view transform.
    """
    matrix, parallel = look.window_matrix, look.window_matrix[3, 2] == 0
    shader = _picture_shader()
    gpu.state.blend_set("MULTIPLY" if look.erases else "ALPHA_PREMULT")
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(not look.xray)
    shader.bind()
    shader.uniform_sampler("colour", picture.colour)
    shader.uniform_sampler("depth", picture.depth)
    shader.uniform_float("lens", (matrix[2, 2], matrix[2, 3], 0.0 if parallel else 1.0, look.darkening))
    shader.uniform_float("frame", look.frame)
    shader.uniform_float("opacity", look.opacity)
    shader.uniform_int("xray", int(look.xray))
    shader.uniform_int("erases", int(look.erases))
    left, bottom, right, top = (2 * edge - 1 for edge in part)
    corners = [(left, bottom), (right, bottom), (left, top), (right, top)]
    batch_for_shader(shader, "TRI_STRIP", {"pos": corners}).draw(shader)
    restore()


def keep_bones(bones: NDArray, size: tuple[int, int], width: float, radius: float) -> None:
    """Let what the view shows of bones in front stay above the picture that is drawn next.

    `bones` [N, 2, 2] are the ends of sticks in pixels of the region with this `size`; `width` and `radius` of sticks
    and joints are in pixels. The depth buffer gets the nearest depth there.
    """
    if len(bones) == 0:
        return
    shader = _bones_shader()
    gpu.state.depth_test_set("ALWAYS")
    gpu.state.depth_mask_set(True)
    gpu.state.color_mask_set(False, False, False, False)
    corners = _triangles(bones, width, radius) / (np.array(size) / 2) - 1
    shader.bind()
    batch_for_shader(shader, "TRIS", {"pos": np.ascontiguousarray(corners, np.float32)}).draw(shader)
    gpu.state.color_mask_set(True, True, True, True)
    restore()


def _triangles(bones: NDArray, width: float, radius: float) -> NDArray[np.float64]:
    """Corners [M * 3, 2] of triangles that cover sticks and joints."""
    along = bones[:, 1] - bones[:, 0]
    side = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(np.linalg.norm(along, axis=1), 1e-6)[:, None]
    side = side[:, None] * width / 2
    sticks = np.concatenate([bones - side, bones + side], 1)[:, [0, 1, 2, 2, 1, 3]].reshape(-1, 2)
    turns = np.arange(_CORNERS + 1) * 2 * np.pi / _CORNERS
    circle = np.stack([np.cos(turns), np.sin(turns)], 1) * radius
    fan = np.stack([np.zeros((_CORNERS, 2)), circle[:-1], circle[1:]], 1).reshape(-1, 2)
    return np.concatenate([sticks, (bones.reshape(-1, 1, 2) + fan).reshape(-1, 2)])


def restore() -> None:
    """Leave the state of drawing as Blender expects of handlers."""
    gpu.state.blend_set("NONE")
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)


@cache_until_exit
def _picture_shader() -> gpu.types.GPUShader:
    info, between = gpu.types.GPUShaderCreateInfo(), gpu.types.GPUStageInterfaceInfo("primdiffusion_picture")
    between.smooth("VEC2", "uv")
    info.vertex_in(0, "VEC2", "pos")
    info.vertex_out(between)
    info.sampler(0, "FLOAT_2D", "colour")
    info.sampler(1, "FLOAT_2D", "depth")
    for kind, name in (
        ("VEC4", "lens"),
        ("VEC4", "frame"),
        ("FLOAT", "opacity"),
        ("INT", "xray"),
        ("INT", "erases"),
    ):
        info.push_constant(kind, name)
    info.fragment_out(0, "VEC4", "picture")
    info.depth_write("ANY")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return gpu.shader.create_from_info(info)


@cache_until_exit
def _bones_shader() -> gpu.types.GPUShader:
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC2", "pos")
    info.fragment_out(0, "VEC4", "unused")
    info.vertex_source("void main() { gl_Position = vec4(pos, -1.0, 1.0); }")
    info.fragment_source("void main() { unused = vec4(0.0); }")
    return gpu.shader.create_from_info(info)
