"""The body of a human: in a file beside the human's, or the default one."""

from __future__ import annotations

import errno

import bpy
import numpy as np
import pytest
import synthetic_shape
from support import tensor_files
from support.errors import refused

from blender_primdiffusion.scene import collect
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.collect import collect_before_saving, unused
from blender_primdiffusion.scene.human import copy_file, folder_of, humans, remove_human, state_folder, volume_path
from blender_primdiffusion.scene.rest_human import body_of_file, shape_model_of

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
    return state_folder(person) / tensor_files.BODY


@pytest.mark.parametrize("name", SPOILED)
def test_a_broken_field_is_named_in_one_sentence(tmp_path, name):
    path = synthetic_shape.write(tmp_path / "human", **SPOILED[name])
    with refused(ValueError, name):
        body_of_file(path)


def test_the_model_comes_back_from_its_file_bit_for_bit(person):
    written, back = synthetic_shape.arrays(), shape_model_of(person)
    for name in ("template", "shape_basis", "joint_basis", "faces", "stencil_vertex", "stencil_du", "skin_weights"):
        np.testing.assert_array_equal(getattr(back, name), written[name])


def test_a_missing_or_damaged_file_is_named_with_what_to_do(person):
    path = body_file(person)
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    with refused(ValueError, "damaged"):
        shape_model_of(person)
    path.unlink()
    with refused(FileNotFoundError, "missing"):
        shape_model_of(person)
    path.write_bytes(whole)
    assert shape_model_of(person).template.shape == (736, 3)


def test_the_file_is_unused_only_when_no_human_has_that_body(person):
    assert unused(folder_of(person).parent) == []
    path, root = body_file(person), folder_of(person).parent
    remove_human(person)
    assert path in unused(root)


def test_saving_for_the_first_time_brings_the_file_along(empty_scene, tmp_path):
    build_human(empty_scene, synthetic_shape.write(tmp_path / "human"))
    bpy.app.handlers.save_pre.append(collect_before_saving)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    finally:
        bpy.app.handlers.save_pre.remove(collect_before_saving)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    (person,) = humans(bpy.context.scene)
    assert body_file(person).is_relative_to(tmp_path / "shöt of two_humans")
    assert shape_model_of(person).template.shape == (736, 3)


@pytest.mark.parametrize("full", [True, False])
def test_links_where_a_save_puts_files_stay_and_lose_nothing_outside(addon, tmp_path, monkeypatch, full):
    bpy.ops.wm.read_factory_settings(use_empty=True)  # a file that was never saved
    person = build_human(bpy.context, synthetic_shape.write(tmp_path / "human"))
    (tmp_path / "outside").mkdir()
    mine = tmp_path / "outside" / "mine"
    mine.write_text("mine")
    source = state_folder(person)
    target = tmp_path / "new_humans" / "Human" / source.name
    target.mkdir(parents=True)
    (target / "person.human.safetensors").write_bytes((source / "person.human.safetensors").read_bytes())
    links = [target / path.name for path in source.glob("*.vdb")]
    for link in links:
        link.symlink_to(mine)
    copied, copy = [], f"{int(source.name) + 1:04d}"

    def copy_some(one, destination, folder, **options):
        copied.append(destination)
        if full and len(copied) == len(links):
            raise OSError(errno.ENOSPC, "no space left")
        return copy_file(one, destination, folder, **options)

    monkeypatch.setattr(collect, "copy_file", copy_some)
    collect_before_saving(str(tmp_path / "new.blend"))
    assert {path.parent.name for path in copied if path.suffix == ".vdb"} == {copy}
    assert all(link.is_symlink() for link in links)
    assert all(volume_path(volume).parent.name == (source.name if full else copy) for volume in bpy.data.volumes)
    assert [path.read_text() for path in mine.parent.iterdir()] == ["mine"]
