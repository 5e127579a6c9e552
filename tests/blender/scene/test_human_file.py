"""A human's file and the file of its body: what is in them, and a sentence for what is wrong with them."""

import json

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_files import folder_of, person_file
from support import tensor_files
from support.errors import refused

from blender_primdiffusion.jobs.export import put
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.human_file import (
    HumanTensors,
    body_beside,
    read_human,
    read_payload,
    read_tensors,
    shape_model_of,
    write_tensors,
)
from blender_primdiffusion.scene.shape import betas_of

pytestmark = pytest.mark.any_blender

COUNT = 12
CHANGE = np.eye(10)[0] * 2.0 - np.eye(10)[1]
SIZES = np.linspace(0.8, 1.3, 3 * COUNT, dtype="<f4").reshape(COUNT, 3)
SPOILED = {
    "rgb": {"rgb": np.zeros((COUNT, 3, 8, 8, 8), np.float16)},
    "density": {"density": np.full((COUNT, 8, 8, 8), -1, np.float32)},
    "half_extent": {"rest_half_extent": np.full((COUNT, 3), -1.0)},
    "full_density": {"meta": np.array('{"full_density": -3}')},
    "provenance": {"meta": np.array("[]")},
    "betas": {"betas": np.full(10, 7.0)},
    "shape_basis": {"shape_basis": np.zeros((7, 3, 10))},
    "template": {"template": np.full((736, 3), np.nan)},
    "faces": {"faces": np.full((1104, 3), 10**6)},
    "face": {"face": np.full(COUNT, 10**6)},
    "barycentric": {"barycentric": np.full((COUNT, 3), 0.5)},
    "skin_weights": {"skin_weights": np.full((736, 24), 0.5)},
    "uv_corner": {"uv_corner": np.full((1104, 3, 2), 1e37)},
    "stencil_vertex": {"stencil_vertex": np.full((COUNT, 5), -1)},
    "stencil_dv": {"stencil_dv": np.full((COUNT, 5), np.inf)},
}
"""Fields of a human and of its body, by what the sentence names."""


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
    np.testing.assert_allclose(exported(person, tmp_path), SIZES, rtol=1e-6)
    now = betas_of(person) + CHANGE
    reshape(person, now)
    growth = synthetic_shape.at(synthetic_shape.arrays(COUNT), now)["growth"]
    assert np.abs(growth - 1).max() > 0.02
    np.testing.assert_allclose(exported(person, tmp_path), SIZES * growth, rtol=1e-5)
    np.testing.assert_allclose(sizes_in(person_file(person)), SIZES, rtol=1e-6)


def test_nothing_is_written_through_a_link_with_a_temporary_name(tmp_path):
    (tmp_path / "source").write_text("new")
    (tmp_path / "mine").write_text("mine")
    for name in (".a.part", ".source.part", ".a.human.part"):
        (tmp_path / name).symlink_to("mine")
    put(tmp_path / "source", tmp_path / "b")
    write_tensors(tmp_path / "a.human", HumanTensors({}, {}))
    assert (tmp_path / "mine").read_text() == "mine"
    assert (tmp_path / "b").read_text() == "new"


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
    path = synthetic_shape.write(tmp_path / "human", COUNT, **SPOILED[name])
    with refused(ValueError, name):
        read_human(path)


def test_a_missing_or_damaged_body_or_that_of_another_is_named(tmp_path):
    with refused(FileNotFoundError, "nobody.human"):
        read_human(tmp_path / "nobody.human")
    file = synthetic_shape.write(tmp_path / "human")
    path = file.with_name(tensor_files.BODY)
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    with refused(ValueError, "damaged"):
        read_human(file)
    path.write_bytes(synthetic.write(tmp_path / "other", 5).with_name(path.name).read_bytes())
    with refused(ValueError, "primitives"):
        read_human(file)
    path.unlink()
    with refused(FileNotFoundError, tensor_files.BODY):
        read_human(file)
    path.write_bytes(whole)
    assert body_beside(file, read_payload(file)).template.shape == (736, 3)


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


def test_the_body_comes_back_bit_for_bit_and_is_written_again_where_it_was_removed(person, tmp_path):
    written, back = synthetic_shape.arrays(), shape_model_of(person)
    for name in ("template", "shape_basis", "joint_basis", "faces", "stencil_vertex", "stencil_du", "skin_weights"):
        np.testing.assert_array_equal(getattr(back, name), written[name])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    (person,) = humans(bpy.context.scene)
    body = folder_of(person) / tensor_files.BODY
    body.unlink()
    assert shape_model_of(person).template.shape == (736, 3)
    assert body.read_bytes() == (tmp_path / "human" / tensor_files.BODY).read_bytes()
