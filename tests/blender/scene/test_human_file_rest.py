"""A human's file: a sentence says what is wrong with it."""

import json

import numpy as np
import pytest
import synthetic
import synthetic_shape
from support import tensor_files
from support.errors import refused

from blender_primdiffusion.scene.human_file import read_human

pytestmark = pytest.mark.any_blender

SPOILED = {
    "rgb": {"rgb": np.zeros((4, 3, 8, 8, 8), np.float16)},
    "density": {"density": np.full((4, 8, 8, 8), -1, np.float32)},
    "half_extent": {"rest_half_extent": np.full((4, 3), -1.0)},
    "full_density": {"meta": np.array('{"full_density": -3}')},
    "provenance": {"meta": np.array("[]")},
    "betas": {"betas": np.full(10, 7.0)},
}
"""Fields of a human of four primitives, by what the sentence names."""


@pytest.mark.parametrize("arrays", [synthetic.arrays(4), synthetic_shape.arrays(4)], ids=["fixed", "shaped"])
def test_a_good_file_gives_back_the_human_at_rest(tmp_path, arrays):
    human = read_human(synthetic.save(tmp_path, arrays))
    assert human.made["seed"] == 0
    for name in ("vertices", "joints", "position", "rotation"):
        np.testing.assert_allclose(getattr(human.rest, name), arrays[name], atol=1e-6)
    np.testing.assert_allclose(human.grids().half_extent, arrays["half_extent"], rtol=1e-6)
    np.testing.assert_allclose(np.moveaxis(human.payload.rgb, 1, -1), arrays["rgb"])
    np.testing.assert_array_equal(human.payload.density, arrays["density"])


@pytest.mark.parametrize("name", SPOILED)
def test_a_broken_field_is_named_in_one_sentence(tmp_path, name):
    path = synthetic.write(tmp_path, 4, **SPOILED[name])
    with refused(ValueError, name):
        read_human(path)


def test_a_human_on_the_body_of_another_is_rejected(tmp_path):
    path = synthetic.write(tmp_path / "a", 4)
    body = synthetic.write(tmp_path / "b", 5).with_name(tensor_files.BODY)
    path.with_name(body.name).write_bytes(body.read_bytes())
    with refused(ValueError, "primitives"):
        read_human(path)


def test_a_deeply_nested_provenance_is_rejected(tmp_path):
    path = synthetic.write(tmp_path, 4)
    arrays, metadata = tensor_files.read_tensors(path)
    tensor_files.write_tensors(path, arrays, {**metadata, "provenance": "[" * 100_000})
    with refused(ValueError, path.name):
        read_human(path)


def test_a_missing_file_is_named(tmp_path):
    with refused(FileNotFoundError, "nobody.human"):
        read_human(tmp_path / "nobody.human")
    path = synthetic.write(tmp_path, 4)
    path.with_name(tensor_files.BODY).unlink()
    with refused(FileNotFoundError, tensor_files.BODY):
        read_human(path)


def test_a_human_on_the_default_body_needs_no_other_file(tmp_path):
    count = 1024
    arrays = {
        "rgb": np.zeros((count, 3, 8, 8, 8), np.float32),
        "density": np.zeros((count, 8, 8, 8), np.float32),
        "delta_scale": np.ones((count, 3), np.float32),
        "betas": np.zeros(10, np.float32),
    }
    metadata = {"format": "primdiffusion.human", "format_version": "1", "provenance": json.dumps({"seed": 3})}
    tensor_files.write_tensors(tmp_path / "a.human", arrays, metadata)
    human = read_human(tmp_path / "a.human")
    assert human.made == {"seed": 3}
    assert human.rest.position.shape == (count, 3)
