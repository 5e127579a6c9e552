"""What is known of a body's shape: in human.npz, in a file beside people's folders, and gone where nobody needs it."""

from __future__ import annotations

import errno

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from support.errors import refused

from blender_primdiffusion.scene import build, collect
from blender_primdiffusion.scene.body_file import body_file_name, read_body_file, saved_body_file, shape_model_of
from blender_primdiffusion.scene.build import attach_volumes, build_human
from blender_primdiffusion.scene.collect import collect_before_saving, unused
from blender_primdiffusion.scene.human import copy_file, folder_of, humans, remove_human, volume_path
from blender_primdiffusion.scene.human_npz import HumanNpzError, read_human
from blender_primdiffusion.scene.shape import FIELDS

SPOILED = {
    "'shape_basis'.*instead of numbers of shape": {"shape_basis": np.zeros((7, 3, 10))},
    "'shape_basis'.*impossible": {"shape_basis": np.zeros((736, 3, 10))},
    "'template'.*impossible": {"template": np.full((736, 3), np.nan)},
    "'face'.*impossible": {"face": np.full(12, 10**6)},
    "'barycentric'.*impossible": {"barycentric": np.full((12, 3), 0.5)},
    "'stencil_vertex'.*impossible": {"stencil_vertex": np.full((12, 5), -1)},
    "'stencil_dv'.*impossible": {"stencil_dv": np.full((12, 5), np.inf)},
}


@pytest.fixture
def person(saved_scene, tmp_path):
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human.npz"))


def body_file(person):
    (path,) = folder_of(person).parent.glob("body_*.npz")
    return path


def test_the_shape_model_gives_the_persons_own_surface_joints_and_frames(tmp_path):
    human = read_human(synthetic_shape.write(tmp_path / "human.npz"))
    rest = human.shape_model.rest(human.betas)
    for name in ("vertices", "joints", "position", "rotation"):
        np.testing.assert_allclose(getattr(rest, name), getattr(human, name), atol=1e-6)


@pytest.mark.parametrize("sentence", SPOILED)
def test_a_broken_field_is_named_in_one_sentence(tmp_path, sentence):
    path = synthetic_shape.write(tmp_path / "human.npz", **SPOILED[sentence])
    with pytest.raises(HumanNpzError, match=sentence) as caught:
        read_human(path)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)


def test_a_file_of_version_2_without_its_fields_is_rejected(tmp_path):
    with refused(HumanNpzError, "template"):
        read_human(synthetic.write(tmp_path / "human.npz", 4, format_version=np.array(2)))


def test_the_model_comes_back_from_its_file_bit_for_bit(person, tmp_path):
    written = read_human(tmp_path / "human.npz").shape_model
    back = shape_model_of(person)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(back, name), getattr(written, name))


def test_people_on_one_body_share_its_file_and_nothing_else_is_left_beside_them(person, saved_scene, tmp_path):
    other = build_human(saved_scene, synthetic_shape.write(tmp_path / "other.npz", rgb=np.zeros((12, 8, 8, 8, 3))))
    assert shape_model_of(other) is shape_model_of(person)
    assert sorted(path.name for path in folder_of(person).parent.iterdir()) == [
        "Human", "Human_001", body_file(person).name
    ]  # fmt: skip


def test_a_human_of_an_earlier_version_has_to_be_generated_again(saved_scene, tmp_path):
    person = build_human(saved_scene, synthetic.write(tmp_path / "human.npz", 8))
    with refused(ValueError, "Human"):
        shape_model_of(person)
    assert not list(folder_of(person).parent.glob("body_*"))


def test_a_missing_or_damaged_file_is_named_with_what_to_do(person):
    path = body_file(person)
    whole = path.read_bytes()
    read_body_file.cache_clear()
    path.write_bytes(whole[:1000])
    with refused(ValueError, "damaged"):
        shape_model_of(person)
    path.unlink()
    with refused(FileNotFoundError, "missing"):
        shape_model_of(person)
    (folder_of(person) / path.name).write_bytes(whole)
    assert shape_model_of(person).template.shape == (736, 3)


def test_a_failure_while_building_leaves_no_file(saved_scene, tmp_path, monkeypatch):
    def failing(*given):
        attach_volumes(*given)
        raise MemoryError("no memory for the volumes")

    monkeypatch.setattr(build, "attach_volumes", failing)
    with pytest.raises(MemoryError):
        build_human(saved_scene, synthetic_shape.write(tmp_path / "human.npz"))
    assert not (tmp_path / "shot_humans").exists()


def test_the_file_is_unused_only_when_no_human_has_that_body(person):
    assert unused(folder_of(person).parent) == []
    path = body_file(person)
    remove_human(person)
    assert path in unused(path.parent)


def test_saving_for_the_first_time_brings_the_file_along(empty_scene, tmp_path):
    build_human(empty_scene, synthetic_shape.write(tmp_path / "human.npz"))
    bpy.app.handlers.save_pre.append(collect_before_saving)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    finally:
        bpy.app.handlers.save_pre.remove(collect_before_saving)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shöt of two.blend"))
    (person,) = humans(bpy.context.scene)
    assert body_file(person).parent == tmp_path / "shöt of two_humans"
    read_body_file.cache_clear()
    assert shape_model_of(person).template.shape == (736, 3)


@pytest.mark.parametrize("there", [True, False])
def test_a_link_in_place_of_the_bodys_file_loses_nothing_outside(tmp_path, there):
    model = read_human(synthetic_shape.write(tmp_path / "human.npz")).shape_model
    (tmp_path / "outside").mkdir()
    mine = tmp_path / "outside" / "mine"
    if there:
        mine.write_text("mine")
    folder = tmp_path / "humans"
    folder.mkdir()
    (folder / body_file_name(model)).symlink_to(mine)
    with pytest.raises(KeyboardInterrupt), saved_body_file(model, folder):
        raise KeyboardInterrupt
    assert [path.read_text() for path in mine.parent.iterdir()] == ["mine"] * there


@pytest.mark.parametrize("full", [True, False])
def test_links_where_a_save_puts_files_stay_and_lose_nothing_outside(addon, tmp_path, monkeypatch, full):
    bpy.ops.wm.read_factory_settings(use_empty=True)  # a file that was never saved
    person = build_human(bpy.context, synthetic_shape.write(tmp_path / "human.npz"))
    (tmp_path / "outside").mkdir()
    mine = tmp_path / "outside" / "mine"
    mine.write_text("mine")
    source = folder_of(person)
    target = tmp_path / "new_humans" / source.name
    target.mkdir(parents=True)
    links = [target / path.name for path in source.glob("*.vdb")]
    for link in links:
        link.symlink_to(mine)
    copied = []

    def copy_some(one, destination, folder, **options):
        copied.append(destination)
        if full and len(copied) == len(links):
            raise OSError(errno.ENOSPC, "no space left")
        return copy_file(one, destination, folder, **options)

    monkeypatch.setattr(collect, "copy_file", copy_some)
    collect_before_saving(str(tmp_path / "new.blend"))
    assert {path.parent.name for path in copied if path.suffix == ".vdb"} == {f"{source.name}_2"}
    assert all(link.is_symlink() for link in links)
    assert all(volume_path(volume).parent.name == source.name + "_2" * (not full) for volume in bpy.data.volumes)
    assert [path.read_text() for path in mine.parent.iterdir()] == ["mine"]
