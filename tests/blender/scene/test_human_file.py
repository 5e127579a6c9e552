"""A reshaped person's .human file: the sizes that boxes have on the body of now."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import synthetic_shape

from blender_primdiffusion.scene.body_file import BODY_FILE
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import person_file
from blender_primdiffusion.scene.human_file import HumanTensors, read_tensors, write_tensors
from blender_primdiffusion.scene.reshape import reshape
from blender_primdiffusion.scene.shape import betas_of

COUNT = 12
CHANGE = np.eye(10)[0] * 2.0 - np.eye(10)[1]
SIZES = np.linspace(0.8, 1.3, 3 * COUNT, dtype="<f4").reshape(COUNT, 3)


def stored(array: np.ndarray) -> tuple[str, tuple[int, ...], bytes]:
    return "F32", array.shape, array.astype("<f4").tobytes()


def sizes_in(path) -> np.ndarray:
    _, shape, raw = read_tensors(path).arrays["delta_scale"]
    return np.frombuffer(raw, "<f4").reshape(shape)


@pytest.fixture
def person(addon, tmp_path):
    arrays = synthetic_shape.arrays(COUNT)
    tensors = {"betas": stored(arrays["betas"]), "delta_scale": stored(SIZES)}
    write_tensors(tmp_path / "person.human.safetensors", HumanTensors({"format": "primdiffusion.human"}, tensors))
    npz = synthetic_shape.write(tmp_path / "human.npz", COUNT)
    return build_human(addon, npz, "Anna", [tmp_path / "person.human.safetensors"])


def exported(person, folder) -> np.ndarray:
    bpy.ops.primdiffusion.export_human(human=person.name, filepath=str(folder / "out.human"), motion=False)
    return sizes_in(folder / "out.human")


def test_boxes_in_the_file_are_as_large_as_in_the_scene(person, tmp_path):
    now = betas_of(person) + CHANGE
    reshape(person, now)
    growth = synthetic_shape.at(synthetic_shape.arrays(COUNT), now)["growth"]
    assert np.abs(growth - 1).max() > 0.02
    np.testing.assert_allclose(exported(person, tmp_path), SIZES * growth, rtol=1e-5)
    np.testing.assert_array_equal(sizes_in(person_file(person)), SIZES)


def test_boxes_of_who_has_their_own_shape_are_as_in_their_file(person, tmp_path):
    np.testing.assert_array_equal(exported(person, tmp_path), SIZES)


def test_boxes_of_people_of_an_earlier_version_keep_their_size(person, tmp_path):
    reshape(person, betas_of(person) + CHANGE)
    del person[BODY_FILE]
    np.testing.assert_array_equal(exported(person, tmp_path), SIZES)
