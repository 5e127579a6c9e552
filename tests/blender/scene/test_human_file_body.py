"""The body of a human: in a file beside the human's, or the default one."""

import bpy
import numpy as np
import pytest
import synthetic_shape
from human_files import folder_of
from support import tensor_files
from support.errors import refused

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.human_file import body_beside, read_payload, shape_model_of

pytestmark = pytest.mark.any_blender

SPOILED = {
    "shape_basis": {"shape_basis": np.zeros((7, 3, 10))},
    "template": {"template": np.full((736, 3), np.nan)},
    "faces": {"faces": np.full((1104, 3), 10**6)},
    "face": {"face": np.full(12, 10**6)},
    "barycentric": {"barycentric": np.full((12, 3), 0.5)},
    "skin_weights": {"skin_weights": np.full((736, 24), 0.5)},
    "uv_corner": {"uv_corner": np.full((1104, 3, 2), 1e37)},
    "stencil_vertex": {"stencil_vertex": np.full((12, 5), -1)},
    "stencil_dv": {"stencil_dv": np.full((12, 5), np.inf)},
}


@pytest.fixture
def person(saved_scene, tmp_path):
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human"))


def body_file(person):
    return folder_of(person) / tensor_files.BODY


@pytest.mark.parametrize("name", SPOILED)
def test_a_broken_field_is_named_in_one_sentence(tmp_path, name):
    path = synthetic_shape.write(tmp_path / "human", **SPOILED[name])
    with refused(ValueError, name):
        body_beside(path, read_payload(path))


def test_the_model_comes_back_from_its_file_bit_for_bit(person):
    written, back = synthetic_shape.arrays(), shape_model_of(person)
    for name in ("template", "shape_basis", "joint_basis", "faces", "stencil_vertex", "stencil_du", "skin_weights"):
        np.testing.assert_array_equal(getattr(back, name), written[name])


def test_a_missing_or_damaged_file_is_named_with_what_to_do(tmp_path):
    file = synthetic_shape.write(tmp_path / "human")
    path = file.with_name(tensor_files.BODY)
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    with refused(ValueError, "damaged"):
        body_beside(file, read_payload(file))
    path.unlink()
    with refused(FileNotFoundError, "missing"):
        body_beside(file, read_payload(file))
    path.write_bytes(whole)
    assert body_beside(file, read_payload(file)).template.shape == (736, 3)


def test_the_file_is_packed_and_written_again_where_it_was_removed(person, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    (person,) = humans(bpy.context.scene)
    body_file(person).unlink()
    assert shape_model_of(person).template.shape == (736, 3)
    assert body_file(person).read_bytes() == (tmp_path / "human" / tensor_files.BODY).read_bytes()
