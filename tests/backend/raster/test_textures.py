"""Textures of a mesh in one array."""

import dataclasses

import numpy as np
from capture_scenes import box
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.raster.textures import gather_textures


def test_a_texture_that_parts_share_is_held_once_and_read_as_before():
    texture = np.random.default_rng(0).integers(0, 256, (13, 8, 4), dtype=np.uint8)
    parts = [dataclasses.replace(box(name), texture=texture) for name in "ab"]
    parts.insert(1, box("plain"))
    shared = TexturedMesh(tuple(parts))
    copied = TexturedMesh(tuple(dataclasses.replace(part, texture=part.texture.copy()) for part in parts))
    one, two = gather_textures(shared), gather_textures(copied)
    assert len(one.rgba) < len(two.rgba)
    assert np.array_equal(one.cut_out, two.cut_out)
    assert np.array_equal(one.size, two.size)
    for first, second, size in zip(one.start.ravel(), two.start.ravel(), one.size.reshape(-1, 2), strict=True):
        texels = int(size.prod())
        assert np.array_equal(one.rgba[first : first + texels], two.rgba[second : second + texels])
    assert one.last.tolist() == [3, 0, 3]
    assert one.size[0].tolist() == [[13, 8], [6, 4], [3, 2], [1, 1]]
