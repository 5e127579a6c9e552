"""A reshaped person's .human file: the sizes that boxes have on the body of now."""

import bpy
import numpy as np
import pytest
import synthetic_shape
from human_files import person_file

from blender_primdiffusion.jobs.export import put
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human_file import HumanTensors, read_tensors, write_tensors
from blender_primdiffusion.scene.shape import betas_of

pytestmark = pytest.mark.any_blender

COUNT = 12
CHANGE = np.eye(10)[0] * 2.0 - np.eye(10)[1]
SIZES = np.linspace(0.8, 1.3, 3 * COUNT, dtype="<f4").reshape(COUNT, 3)


def sizes_in(path) -> np.ndarray:
    _, shape, raw = read_tensors(path).arrays["delta_scale"]
    return np.frombuffer(raw, "<f4").reshape(shape)


@pytest.fixture
def person(addon, tmp_path):
    half = synthetic_shape.arrays(COUNT)["rest_half_extent"] * SIZES
    return build_human(addon, synthetic_shape.write(tmp_path / "human", COUNT, half_extent=half), "Anna")


def exported(person, folder) -> np.ndarray:
    bpy.ops.primdiffusion.export(human=person.name, filepath=str(folder / "out.human"))
    return sizes_in(folder / "out.human")


def test_boxes_in_the_file_are_as_large_as_in_the_scene(person, tmp_path):
    now = betas_of(person) + CHANGE
    reshape(person, now)
    growth = synthetic_shape.at(synthetic_shape.arrays(COUNT), now)["growth"]
    assert np.abs(growth - 1).max() > 0.02
    np.testing.assert_allclose(exported(person, tmp_path), SIZES * growth, rtol=1e-5)
    np.testing.assert_allclose(sizes_in(person_file(person)), SIZES, rtol=1e-6)


def test_boxes_of_who_has_their_own_shape_are_as_in_their_file(person, tmp_path):
    np.testing.assert_allclose(exported(person, tmp_path), SIZES, rtol=1e-6)


def test_nothing_is_written_through_a_link_with_a_temporary_name(tmp_path):
    (tmp_path / "source").write_text("new")
    (tmp_path / "mine").write_text("mine")
    for name in (".a.part", ".source.part", ".a.human.part"):
        (tmp_path / name).symlink_to("mine")
    put(tmp_path / "source", tmp_path / "b")
    write_tensors(tmp_path / "a.human", HumanTensors({}, {}))
    assert (tmp_path / "mine").read_text() == "mine"
    assert (tmp_path / "b").read_text() == "new"
