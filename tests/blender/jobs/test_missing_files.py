"""Files of people that are missing: noticed, found wherever they are, made again where they are nowhere."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from jobs_driven import shown
from support.errors import refused
from support.fake_child import request_of

from blender_primdiffusion.jobs.missing_files import look, state
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import HOME, MARK, folder_of, humans, person_file, state_folder, volume_path
from blender_primdiffusion.scene.missing import missing_files
from blender_primdiffusion.ui.human_panel import PRIMDIFFUSION_PT_human

pytestmark = pytest.mark.any_blender

ops = bpy.ops.primdiffusion
COUNT = 8


@pytest.fixture
def store(tmp_path, monkeypatch, addon):
    folder = tmp_path / "store"
    folder.mkdir()
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(folder, COUNT)))
    return folder


@pytest.fixture
def person(store, addon):
    made = build_human(addon, store / "person.human.safetensors", "Anna")
    bpy.ops.wm.save_mainfile()
    return made


def reopened(path: Path | str = ""):
    bpy.ops.wm.open_mainfile(filepath=str(path or bpy.data.filepath))
    return humans(bpy.context.scene)[0]


def whole(person) -> bool:
    volumes = {obj.data for obj in person.all_objects if obj.type == "VOLUME"}
    assert len(volumes) == COUNT
    return all(volume.grids.load() for volume in volumes) and person_file(person).is_file() and not missing_files()


def test_the_panel_is_empty_when_no_file_is_missing(person, addon):
    look()
    assert state.summary == ""
    assert "primdiffusion.find_missing_volumes" not in shown(PRIMDIFFUSION_PT_human, addon)
    assert ops.find_missing_volumes() == {"FINISHED"}


def test_a_folder_that_was_renamed_is_found_in_one_click(person, tmp_path):
    shutil.move(tmp_path / "shot_humans", tmp_path / "backup_humans")
    anna = reopened()
    assert state.summary == "person.human.safetensors of 'Anna'"
    assert "primdiffusion.find_missing_volumes" in shown(PRIMDIFFUSION_PT_human, bpy.context)
    assert ops.find_missing_volumes() == {"FINISHED"}
    assert whole(anna)
    assert state.summary == ""
    assert all(volume.filepath.startswith("//backup_humans/Anna/0001/") for volume in bpy.data.volumes)


def test_a_blend_moved_alone_finds_people_where_they_were_when_it_was_saved(person, tmp_path):
    elsewhere = tmp_path / "somewhere else"
    elsewhere.mkdir()
    shutil.move(tmp_path / "shot.blend", elsewhere / "neu.blend")
    anna = reopened(elsewhere / "neu.blend")
    assert state.summary
    assert ops.find_missing_volumes() == {"FINISHED"}
    assert whole(anna)
    assert volume_path(bpy.data.volumes[0]).resolve().parent == tmp_path / "shot_humans" / "Anna" / "0001"


def test_a_folder_may_be_named_and_undo_goes_back(person, tmp_path):
    deep = tmp_path / "NAS" / "2024 %20 'x'" / "people"
    deep.parent.mkdir(parents=True)
    shutil.move(tmp_path / "shot_humans", deep)
    anna = reopened()
    del anna[HOME]
    with refused(RuntimeError, "Generate Again"):
        ops.find_missing_volumes()
    with refused(RuntimeError, "folder"):
        ops.find_missing_volumes(directory=str(tmp_path / "nowhere"))
    bpy.ops.ed.undo_push(message="before")
    assert ops.find_missing_volumes(directory=str(tmp_path / "NAS")) == {"FINISHED"}
    assert whole(anna)
    bpy.ops.ed.undo()
    assert len(missing_files()) == 1
    assert state.summary


def test_volumes_that_are_nowhere_are_not_missing_but_written_again(person):
    before = {volume.name: volume.filepath for volume in bpy.data.volumes}
    for path in list(state_folder(person).glob("prim_*"))[:3]:
        path.unlink()
    anna = reopened()
    assert state.summary == ""
    assert ops.find_missing_volumes() == {"FINISHED"}
    assert whole(anna)
    assert {volume.name: volume.filepath for volume in bpy.data.volumes} == before


def test_files_that_vanish_while_the_person_is_shown_come_back(person):
    assert all(volume.grids.load() for volume in bpy.data.volumes)
    for path in state_folder(person).glob("prim_*"):
        path.unlink()
    assert ops.find_missing_volumes() == {"FINISHED"}
    assert whole(person)


def test_a_lost_body_is_found_with_a_copy_of_the_human(person, store):
    (state_folder(person) / "body.safetensors").unlink()
    anna = reopened()
    assert state.summary == "body.safetensors of 'Anna'"
    assert ops.find_missing_volumes(directory=str(store)) == {"FINISHED"}
    assert whole(anna)


def test_all_of_a_person_lost_but_their_file_elsewhere(person, store, tmp_path):
    shutil.rmtree(tmp_path / "shot_humans")
    anna = reopened()
    other, kept = synthetic_shape.write(tmp_path / "other", COUNT, seed=3).parent, tmp_path / "mail"
    with pytest.raises(RuntimeError, match="cannot be found"):
        ops.find_missing_volumes(directory=str(other))
    shutil.copytree(store, kept)
    assert ops.find_missing_volumes(directory=str(kept)) == {"FINISHED"}
    assert whole(anna)
    assert not list(kept.glob("prim_*")), "nothing is written in a folder that is not the file's own"


def test_a_human_without_any_file_left_is_generated_again(person, tmp_path):
    shutil.rmtree(tmp_path / "shot_humans")
    anna = reopened()
    assert "primdiffusion.generate_again" in shown(PRIMDIFFUSION_PT_human, bpy.context)
    with refused(RuntimeError, "Generate Again"):
        ops.find_missing_volumes()
    assert ops.generate_again() == {"FINISHED"}
    assert whole(anna)
    assert request_of(person_file(anna))["seed"] == 0
    with pytest.raises(RuntimeError, match="is there"):
        ops.generate_again()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"edits": [{"edit": "vary"}]}, "was edited"),
        ({"seed": None}, "not generated from a seed"),
        ({"checkpoint": "another"}, "another human"),
    ],
)
def test_humans_that_no_seed_reproduces_are_rejected(person, tmp_path, changes, sentence):
    shutil.rmtree(tmp_path / "shot_humans")
    person[MARK] = json.dumps({**json.loads(person[MARK]), **changes})
    with pytest.raises(RuntimeError, match=sentence):
        ops.generate_again()
    assert not (tmp_path / "shot_humans").exists()


def test_a_person_in_a_lost_folder_of_a_linked_blend_is_reported(person, tmp_path):
    shutil.move(tmp_path / "shot_humans", tmp_path / "gone")
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "shot.blend"), link=True) as (_, wanted):
        wanted.collections = ["Anna"]
    with refused(RuntimeError, "linked"):
        ops.find_missing_volumes()


def test_missing_files_of_a_thousand_volumes_are_one_entry(person):
    for number in range(1024):
        copy = bpy.data.volumes.new(f"more_{number}")
        copy.filepath = f"//nowhere/Anna/0001/prim_{number:04d}.vdb"
        person.objects.link(bpy.data.objects.new(copy.name, copy))
    (lost,) = missing_files()
    assert len(lost.volumes) == 1024 + COUNT


def test_a_missing_file_offers_the_button_where_a_job_fails(person):
    from blender_primdiffusion.jobs.remedies import error_in_the_scene, remedy_for

    person_file(person).unlink()
    with refused(FileNotFoundError, "Find Missing Volumes") as failed:
        person_file(person)
    assert remedy_for(error_in_the_scene(failed.value)).operator == "primdiffusion.find_missing_volumes"


def test_a_merged_volume_that_is_lost_asks_to_merge_again(person, tmp_path):
    from blender_primdiffusion.scene.merged import MergedState, show_merged

    lost = folder_of(person) / "merged_0123456789ab.vdb"
    shutil.copy(next(state_folder(person).glob("prim_*")), lost)
    show_merged(person, [lost], MergedState(("x",), 0.01))
    assert not missing_files()
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    shutil.move(lost, moved)
    with refused(RuntimeError, "Anna"):
        ops.find_missing_volumes()
    assert ops.find_missing_volumes(directory=str(moved)) == {"FINISHED"}
    assert not missing_files()
