"""The edits from the operator to the human's file, with the real child and a small model."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from human_files import person_file

from blender_primdiffusion.scene.human import MARK, humans

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
ops = bpy.ops.primdiffusion


@pytest.fixture
def people(real_child):
    """Two people of a small model."""
    settings = real_child.scene.primdiffusion
    settings.steps, settings.sampler, settings.attributes.outfit = 2, "dpmpp_2m", "suit"
    ops.generate(seed=1)
    settings.sampler, settings.attributes.outfit = "ddim", "ANY"
    ops.generate(seed=2)
    settings.steps = 3
    return humans(real_child.scene)


def voxels(person) -> np.ndarray:
    """Those of each primitive [K, n]."""
    tensors = payload(person_file(person))
    return np.concatenate([tensors[name].reshape(len(tensors[name]), -1) for name in ("rgb", "density")], 1)


def changed(before: np.ndarray, after: np.ndarray) -> set[int]:
    return set(np.flatnonzero((before != after).any(1)).tolist())


def region(*parts: str) -> set[int]:
    from primdiffusion.editing.regions import region_of

    return set(np.flatnonzero(region_of(parts).numpy()).tolist())


def payload(path: Path) -> dict[str, np.ndarray]:
    from safetensors.numpy import load_file

    return load_file(path)


def test_redressing_leaves_everything_outside_the_region_as_it_is(people):
    anna, berta = people
    before, others, first = voxels(anna), voxels(berta), payload(person_file(anna))
    assert json.loads(anna[MARK])["attributes"] == {"outfit": "suit"}
    settings = bpy.context.scene.primdiffusion_edit
    settings.parts, settings.attributes.outfit = {"hair", "shoes"}, "suit"
    assert ops.redress(human="Human", seed=5) == {"FINISHED"}
    inside = region("hair", "shoes")
    differ = changed(before, voxels(anna))
    assert differ
    assert differ <= inside
    assert not changed(voxels(berta), others)
    second = payload(person_file(anna))
    outside = sorted(set(range(len(before))) - inside)
    assert all(np.array_equal(first[name][outside], second[name][outside]) for name in ("rgb", "density"))
    assert np.array_equal(first["betas"], second["betas"])


def test_vary_transfer_and_blend_follow_one_another_and_undo_goes_back_through_them(people):
    anna, berta = people
    bpy.ops.ed.undo_push(message="two people")
    settings, states = bpy.context.scene.primdiffusion_edit, [voxels(anna)]
    settings.other, settings.parts, settings.fraction = berta, {"top"}, 1.0
    assert ops.vary(human="Human", seed=3) == {"FINISHED"}
    states.append(voxels(anna))
    assert ops.transfer_texture(human="Human") == {"FINISHED"}
    states.append(voxels(anna))
    assert changed(states[1], states[2]) <= region("top")
    settings.what, settings.harmonise = "garment", 0.5
    assert ops.transfer_texture(human="Human") == {"FINISHED"}
    states.append(voxels(anna))
    assert ops.blend(human="Human") == {"FINISHED"}
    ours, theirs = (json.loads(person[MARK])["betas"] for person in (anna, berta))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    for state in reversed(states):
        bpy.ops.ed.undo()
        anna = humans(bpy.context.scene)[0]
        assert not changed(voxels(anna), state)
