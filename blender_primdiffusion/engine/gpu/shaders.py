"""The marcher's compute shaders (docs/design/marcher.md), in the GLSL that Blender translates for OpenGL, Vulkan and
Metal, and a cache of what is made once on the GPU. `march` documents the box records that they read."""

from __future__ import annotations

import atexit
import functools
from collections.abc import Callable
from typing import TypeVar

import gpu

TILE = 8
"""Pixels along a side of the tile that a work group marches."""
ACROSS = 32
"""Boxes along a side of the atlas."""
VOXELS = 8
"""Along a side of a box."""
TEXELS = 9
"""Texels of a box record."""
BOXES_A_ROW = 128
ENTRIES_A_ROW = 4096
WIDER = 8
"""Tiles are listed out of lists of tiles that are as many times wider."""
CHUNK = 16
"""Lattice points, of the finest in a tile, that are composited together."""
MOST_CHUNKS = 2**16
"""Largest number of chunks of a ray."""

_RECORDS = f"""
vec4 record(int box, int texel)
{{
  return texelFetch(boxes, ivec2((box % {BOXES_A_ROW}) * {TEXELS} + texel, box / {BOXES_A_ROW}), 0);
}}

int entry(int place)
{{
  return int(texelFetch(entries, ivec2(place % {ENTRIES_A_ROW}, place / {ENTRIES_A_ROW}), 0).x);
}}
"""

_LIST = (
    _RECORDS
    + f"""
void store(int place, int value)
{{
  imageStore(entries_image, ivec2(place % {ENTRIES_A_ROW}, place / {ENTRIES_A_ROW}), uvec4(uint(value)));
}}

void main()
{{
  ivec2 tile = ivec2(gl_GlobalInvocationID.xy);
  if (tile.x >= tiling.x || tile.y >= tiling.y) {{
    return;
  }}
  vec2 first = vec2(tile * tiling.z);
  vec2 last = first + float(tiling.z - 1);
  vec2 span = vec2(-1.0, float(tiling.w));
  if (tiling.w < 0) {{
    span = texelFetch(wide_tiles, tile / {WIDER}, 0).xy;
  }}
  int begin = int(texelFetch(tiles, tile, 0).x);
  int place = begin + 1;
  float finest = 1e6;
  for (int i = 0; i < int(span.y); i++) {{
    int box = tiling.w < 0 ? entry(int(span.x) + 1 + i) : i;
    vec4 reach = record(box, 8);
    if (last.x >= reach.x && last.y >= reach.y && first.x <= reach.z && first.y <= reach.w) {{
      store(place, box);
      place += 1;
      finest = min(finest, record(box, 0).w);
    }}
  }}
  store(begin, int(finest));
}}
"""
)

_MARCH = (
    _RECORDS
    + f"""
float along(float slope)
{{
  return abs(slope) < 1e-12 ? 1e-12 : slope;
}}

void main()
{{
  ivec2 pixel = (ivec2(gl_WorkGroupID.xy) + ivec2(0, tiling.x)) * {TILE} + ivec2(gl_LocalInvocationID.xy);
  if (pixel.x >= size.x || pixel.y >= size.y) {{
    return;
  }}
  ivec2 target = ivec2(pixel.x, size.y - 1 - pixel.y);
  float spacing = lattice.x;
  float base = lattice.y;
  float base_depth = lattice.z;

  /* Lattice points are counted from `base`; `secant` is a ray's length per metre along the optical axis. */
  vec2 slope = (vec2(pixel) + 0.5 - lens.zw) / lens.xy;
  float squared = dot(slope, slope);
  float secant = sqrt(1.0 + squared);
  float shift = base * (squared / (secant + 1.0));
  float ray_first = max(ceil(planes.x * secant + shift), 1.0 - base);
  float ray_last = floor(min(planes.y * secant + shift, 1.6e7));
  if (tiling.z != 0) {{
    float end = (texelFetch(ends, target, 0).x - base_depth) / spacing;
    ray_last = min(ray_last, floor(end * secant + shift));
  }}

  vec2 span = texelFetch(tiles, pixel / tiling.y, 0).xy;
  int opened = int(span.x) + 1;
  int closed = opened + clamp(int(span.y), 0, tiling.w);
  vec4 colour = vec4(0.0);
  float surface = 1e10;
  vec4 sums[{CHUNK}];
  float finest = max(float(entry(int(span.x))), 1.0);
  float begin = 3e7;
  if (span.y > 0.5) {{
    begin = floor(record(entry(opened), 0).y / finest) * finest;
  }}

  /* Loops count integers, so that no number, not even NaN from a faulty driver, makes them endless. */
  for (int chunk = 0; chunk < {MOST_CHUNKS} && opened < closed && begin <= ray_last && colour.a < 1.0; chunk++) {{
    for (int i = 0; i < {CHUNK}; i++) {{
      sums[i] = vec4(0.0);
    }}
    float stop = begin + finest * {CHUNK}.0;
    float next = 3e7;
    for (int place = opened; place < closed; place++) {{
      int box = entry(place);
      vec4 reach = record(box, 0);
      if (reach.y >= stop) {{
        next = min(next, reach.y);
        break;
      }}
      if (reach.z >= stop) {{
        next = min(next, max(reach.y, stop));
      }}
      if (reach.z < begin) {{
        continue;
      }}
      vec4 right = record(box, 1);
      vec4 down = record(box, 2);
      vec4 middle = record(box, 3);
      vec4 offset = record(box, 4);
      vec4 low = record(box, 5);
      vec4 high = record(box, 6);
      vec4 centre = record(box, 7);

      /* The ray in the box is p + (n - n0) q, see `march`. */
      float du = (float(pixel.x) - centre.x) + centre.y;
      float dv = (float(pixel.y) - centre.z) + centre.w;
      float more = du * (down.w + du * metric.x) + dv * (middle.w + dv * metric.y);
      float root = sqrt(right.w * right.w + more);
      vec3 turn = (du * right.xyz + dv * down.xyz - (more / (root + right.w)) * middle.xyz) / root;
      vec3 p = offset.xyz + offset.w * turn;
      vec3 q = (middle.xyz + turn) * spacing;
      q = vec3(along(q.x), along(q.y), along(q.z));
      vec3 one = (low.xyz - p) / q;
      vec3 other = (high.xyz - p) / q;
      vec3 enter = min(one, other);
      vec3 leave = max(one, other);
      float first = max(max(enter.x, enter.y), enter.z);
      float last = min(min(leave.x, leave.y), leave.z);
      float stride = max(reach.w, 1.0);
      first = max(max(first + reach.x, begin), ray_first);
      last = min(min(last + reach.x, stop - 1.0), ray_last);
      float brick = high.w;
      float row = floor(brick / {ACROSS}.0);
      float layer = floor(row / lattice.w);
      vec3 origin = vec3(brick - row * {ACROSS}.0, row - layer * lattice.w, layer) * {VOXELS}.0;

      first = ceil(first / stride) * stride;
      int count = int(clamp(floor((last - first) / stride) + 1.0, 0.0, {CHUNK}.0));
      for (int i = 0; i < count; i++) {{
        float n = first + float(i) * stride;
        vec3 y = p + (n - reach.x) * q;
        /* Voxel centres are at the corners, so filtering stays in the brick. */
        vec4 value = textureLod(atlas, (origin + clamp((y + 1.0) * 3.5, 0.0, 7.0) + 0.5) / atlas_size, 0.0);
        vec3 y2 = y * y;
        vec3 y4 = y2 * y2;
        float opacity = value.a * exp(-8.0 * dot(y4, y4)) * low.w;
        sums[clamp(int((n - begin) / finest), 0, {CHUNK} - 1)] += vec4(value.rgb * opacity, opacity);
      }}
    }}

    for (int i = 0; i < {CHUNK}; i++) {{
      float opacity = sums[i].a;
      float missing = 1.0 - colour.a;
      if (opacity > 0.0 && missing > 0.0) {{
        bool ends_here = opacity >= missing;
        colour.rgb += sums[i].rgb * (ends_here ? missing / opacity : 1.0);
        colour.a = ends_here ? 1.0 : colour.a + opacity;
        if (surface > 1e9 && colour.a >= 0.5) {{
          surface = spacing * ((begin + finest * float(i) - shift) / secant) + base_depth;
        }}
      }}
    }}
    begin = floor(next / finest) * finest;
    for (int place = opened; place < closed; place++) {{
      if (record(entry(place), 0).z >= begin) {{
        break;
      }}
      opened = place + 1;
    }}
  }}
  imageStore(colour_image, target, colour);
  imageStore(depth_image, target, vec4(surface));
}}
"""
)

_COPY = """
void main()
{
  ivec3 at = ivec3(gl_GlobalInvocationID.xyz);
  imageStore(atlas_image, at + ivec3(0, 0, layer), texelFetch(one, at, 0));
}
"""

_REBIND = """
void main()
{
  imageStore(image_0, ivec2(0), vec4(0.0));
  imageStore(image_1, ivec2(0), vec4(0.0));
}
"""
Made = TypeVar("Made")


def list_shader() -> gpu.types.GPUShader:
    """Writes each tile's list, one invocation a tile: the finest stride, then the boxes that the tile may see in the
    order of their first lattice points, out of all boxes or of the lists of wider tiles."""
    info = gpu.types.GPUShaderCreateInfo()
    info.sampler(0, "FLOAT_2D", "boxes")
    info.sampler(1, "FLOAT_2D", "tiles")
    info.sampler(2, "FLOAT_2D", "wide_tiles")
    info.sampler(3, "UINT_2D", "entries")
    info.image(0, "R32UI", "UINT_2D", "entries_image", qualifiers={"WRITE"})
    info.push_constant("IVEC4", "tiling")
    return compiled(info, _LIST, (TILE, TILE))


def march_shader() -> gpu.types.GPUShader:
    """Marches the rays of a tile's pixels, one invocation a pixel."""
    info = gpu.types.GPUShaderCreateInfo()
    for slot, (kind, name) in enumerate(
        [
            ("FLOAT_2D", "boxes"),
            ("FLOAT_2D", "tiles"),
            ("UINT_2D", "entries"),
            ("FLOAT_3D", "atlas"),
            ("FLOAT_2D", "ends"),
        ]
    ):
        info.sampler(slot, kind, name)
    info.image(0, "RGBA16F", "FLOAT_2D", "colour_image", qualifiers={"WRITE"})
    info.image(1, "R32F", "FLOAT_2D", "depth_image", qualifiers={"WRITE"})
    for kind, name in [("VEC4", "lens"), ("VEC4", "lattice"), ("VEC2", "planes"), ("VEC2", "metric")]:
        info.push_constant(kind, name)
    info.push_constant("VEC3", "atlas_size")
    info.push_constant("IVEC2", "size")
    info.push_constant("IVEC4", "tiling")
    return compiled(info, _MARCH, (TILE, TILE))


def copy_shader() -> gpu.types.GPUShader:
    """Copies the atlas of one human into layers of a common one."""
    info = gpu.types.GPUShaderCreateInfo()
    info.sampler(0, "FLOAT_3D", "one")
    info.image(0, "RGBA16F", "FLOAT_3D", "atlas_image", qualifiers={"WRITE"})
    info.push_constant("INT", "layer")
    return compiled(info, _COPY, (8, 8))


def rebind_shader() -> gpu.types.GPUShader:
    """Writes a pixel of the images at both units; see `GpuMarcher.march`."""
    info = gpu.types.GPUShaderCreateInfo()
    for unit in (0, 1):
        info.image(unit, "R32F", "FLOAT_2D", f"image_{unit}", qualifiers={"WRITE"})
    return compiled(info, _REBIND, (1, 1))


def compiled(info: gpu.types.GPUShaderCreateInfo, source: str, group: tuple[int, int]) -> gpu.types.GPUShader:
    """A compute shader with groups of this size. Raises RuntimeError as `shader_of`."""
    info.local_group_size(*group)
    info.compute_source(source)
    return shader_of(info)


def shader_of(info: gpu.types.GPUShaderCreateInfo) -> gpu.types.GPUShader:
    """The shader. Raises RuntimeError where it does not compile."""
    try:
        return gpu.shader.create_from_info(info)
    except Exception as error:  # Blender raises Exception itself
        raise RuntimeError(f"a shader does not compile on this GPU: {error}") from error


def cache_until_exit(make: Callable[[], Made]) -> Callable[[], Made]:
    """As `functools.cache`, for functions that make objects on the GPU: emptied when Python exits.

    Blender 5.2 as a module frees its GPU before Python frees what modules still hold, and crashes.
    """
    cached = functools.cache(make)
    atexit.register(cached.cache_clear)
    return cached
