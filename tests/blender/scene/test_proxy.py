"""The material of a proxy, and how Solid shading shows it."""

from __future__ import annotations

import bpy
import exporting
import numpy as np
import pytest
from blender_primdiffusion.formats.answers import ProxyAnswer
from support.errors import refused

from blender_primdiffusion.jobs.export import AddProxyJob
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import HumanTarget
from blender_primdiffusion.scene.proxy import build_proxy, is_outdated, read_proxy, show_textures_in_solid
from blender_primdiffusion.scene.shape import betas_of

pytestmark = pytest.mark.any_blender


def views() -> list[bpy.types.SpaceView3D]:
    spaces = (space for screen in bpy.data.screens for area in screen.areas for space in area.spaces)
    return [space for space in spaces if space.type == "VIEW_3D"]


def test_solid_shading_shows_textures_unless_the_user_has_chosen_other_colours():
    bpy.ops.wm.read_factory_settings()
    first, second, wires, *_ = views()
    assert first.shading.color_type == "MATERIAL"
    second.shading.color_type = "RANDOM"
    wires.shading.type = "WIREFRAME"
    show_textures_in_solid()
    assert (first.shading.color_type, second.shading.color_type) == ("TEXTURE", "RANDOM")
    wires.shading.type = "SOLID"
    assert wires.shading.color_type == "MATERIAL"


def test_a_proxys_material_is_shown_with_its_texture_or_its_mean_colour(saved_scene, tmp_path):
    exporting.write_store(tmp_path)
    person = exporting.add_person(tmp_path)
    proxy = build_proxy(person, read_proxy(tmp_path / "proxy.npz"), tmp_path / "proxy.png")
    (material,) = proxy.data.materials
    picture = material.node_tree.nodes.active.image
    mean = np.array(picture.pixels).reshape(-1, 4)[:, :3].mean(0)
    assert mean == pytest.approx([1.0, 0.0, 0.0])
    assert list(material.diffuse_color) == pytest.approx([1.0, 0.0, 0.0, 1.0], abs=1e-4)


def test_a_proxy_of_another_shape_is_outdated_and_none_is_made(saved_scene, tmp_path):
    exporting.write_store(tmp_path)
    person = exporting.add_person(tmp_path)
    proxy, before = build_proxy(person, read_proxy(tmp_path / "proxy.npz"), tmp_path / "proxy.png"), betas_of(person)
    assert not is_outdated(person, proxy)
    reshape(person, before + np.eye(10)[0])
    assert is_outdated(person, proxy)
    result = ProxyAnswer(
        proxy=tmp_path / "proxy.npz", texture=tmp_path / "proxy.png", triangles=500, betas=before.tolist(), seconds=1.0
    )
    with refused(ValueError, person.name):
        AddProxyJob(HumanTarget.of(person), 64, 500).built(person, result)
    reshape(person, before)
    assert not is_outdated(person, proxy)
