"""A mesh proxy in the scene follows the person's shape, as far as nobody has locked its mesh."""

from __future__ import annotations

import bpy
import exporting
import numpy as np
import pytest
import synthetic
import synthetic_shape
from blender_primdiffusion.formats.answers import ProxyAnswer
from scene_stage import replace

from blender_primdiffusion.jobs.export import AddProxyJob
from blender_primdiffusion.jobs.target import HumanTarget
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import body_of, link_part, proxy_of
from blender_primdiffusion.scene.proxy import build_proxy, is_outdated, read_proxy, shown_betas
from blender_primdiffusion.scene.shape import betas_of, generated_betas

TALLER, WIDER = np.eye(10)[0] * 2.0, np.eye(10)[1] * 2.0


@pytest.fixture
def person(saved_scene, tmp_path):
    """Somebody whose proxy has the vertices of their body."""
    exporting.write_store(tmp_path)
    person = build_human(saved_scene, synthetic_shape.write(tmp_path / "human"))
    arrays = dict(np.load(tmp_path / "proxy.npz"))
    arrays["vertices"] = synthetic_shape.arrays()["vertices"]
    np.savez(tmp_path / "proxy.npz", **arrays)
    made = generated_betas(person)
    link_part(person, build_proxy(person, read_proxy(tmp_path / "proxy.npz"), tmp_path / "proxy.png", made))
    return person


def places(obj) -> np.ndarray:
    return np.array([vertex.co for vertex in obj.data.vertices])


def model(betas) -> np.ndarray:
    """The body at rest in the body model's space, z up [V, 3]."""
    return points_to_blender(synthetic_shape.at(synthetic_shape.arrays(), betas)["vertices"])


def surface(betas) -> np.ndarray:
    """The same, standing on the armature's origin."""
    return model(betas) - [0, 0, model(betas)[:, 2].min()]


@pytest.mark.parametrize("change", [TALLER, WIDER, TALLER - WIDER])
def test_the_proxy_goes_where_the_body_goes(person, change):
    proxy, before = proxy_of(person), betas_of(person)
    reshape(person, before + change)
    moved = np.linalg.norm(surface(before + change) - surface(before), axis=-1)
    off = np.linalg.norm(places(proxy) - surface(before + change), axis=-1)
    assert moved.max() > 0.05
    assert np.sqrt((off**2).mean()) < 0.15 * np.sqrt((moved**2).mean()), "neighbours' mean, not the vertex' own way"
    assert np.allclose(shown_betas(proxy), before + change)
    assert not is_outdated(person, proxy, betas_of(person))


def test_an_edit_that_changes_the_body_takes_the_proxy_along(person, tmp_path):
    after = betas_of(person) + TALLER
    edited = {**synthetic_shape.at(synthetic_shape.arrays(), after), "meta": np.array('{"seed": 9}')}
    assert replace(person, synthetic.save(tmp_path / "edited", edited)).reshaped
    proxy = proxy_of(person)
    assert np.linalg.norm(places(proxy) - surface(after), axis=-1).mean() < 0.02
    assert np.allclose(shown_betas(proxy), after)


def test_there_and_back_the_proxy_is_what_it_was_with_what_was_sculpted(person):
    proxy, before = proxy_of(person), betas_of(person)
    proxy.data.vertices[3].co.x += 0.3
    as_sculpted = places(proxy)
    for change in (TALLER, WIDER, -TALLER):
        reshape(person, before + change)
    reshape(person, before)
    np.testing.assert_allclose(places(proxy), as_sculpted, atol=1e-5)


@pytest.mark.parametrize("lock", ["shape keys", "edit mode", "linked mesh"])
def test_a_proxy_that_cannot_follow_stays_and_is_outdated(person, lock, tmp_path):
    proxy = proxy_of(person)
    if lock == "shape keys":
        proxy.shape_key_add(name="Basis")
    elif lock == "linked mesh":
        bpy.data.libraries.write(str(tmp_path / "meshes.blend"), {proxy.data})
        with bpy.data.libraries.load(str(tmp_path / "meshes.blend"), link=True) as (_, linked):
            linked.meshes = [proxy.data.name]
        proxy.data = linked.meshes[0]
    else:
        bpy.context.view_layer.objects.active = proxy
        bpy.ops.object.mode_set(mode="EDIT")
    still = places(proxy)
    reshape(person, betas_of(person) + TALLER)
    np.testing.assert_array_equal(places(proxy), still)
    assert is_outdated(person, proxy, betas_of(person))
    assert np.abs(places(body_of(person)) - still).max() > 0.05, "the body has moved"
    if lock == "edit mode":
        bpy.ops.object.mode_set(mode="OBJECT")


def test_a_human_reshaped_during_the_job_gets_a_proxy_of_its_new_body(person, tmp_path):
    before = betas_of(person)
    followed = proxy_of(person)
    reshape(person, before + TALLER)
    result = ProxyAnswer(
        proxy=tmp_path / "proxy.npz", texture=tmp_path / "proxy.png", triangles=500, betas=before.tolist(), seconds=1.0
    )
    made = AddProxyJob(HumanTarget.of(person), 64, 500).built(person, result)
    np.testing.assert_allclose(places(made), places(followed), atol=1e-5)
    assert not is_outdated(person, made, betas_of(person))
