"""A person in the scene on their way to become another, and all that can happen meanwhile."""

from __future__ import annotations

import json
import time
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from jobs_driven import drive, error_of, notice_of

import blender_primdiffusion
from blender_primdiffusion.jobs.edit import RegenerateJob, VaryJob, made_from_seed
from blender_primdiffusion.jobs.follow import building, follow
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.jobs.target import HumanTarget
from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.human import (
    MARK,
    folder_of,
    humans,
    person_file,
    remove_human,
    state_folder,
    volume_path,
)

pytestmark = [pytest.mark.any_blender, pytest.mark.usefixtures("volumes_shown")]

FINE = 8
"""A seed that is no order to the fake child."""
COUNT = 12
"""Primitives of the synthetic person."""
SLICE_SECONDS = "blender_primdiffusion.jobs.follow.SLICE_S"


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(tmp_path / "prepared", COUNT)))
    bpy.ops.primdiffusion.generate(seed=7, steps=1)
    bpy.ops.ed.undo_push(message="a person")
    return humans(addon.scene)[0]


@pytest.fixture
def varied(person, monkeypatch):
    """The person, whose other volumes are written and not shown yet."""
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    vary(person)
    until_written()
    return person


def vary(person, seed: int = FINE) -> None:
    queue.add(bpy.context, VaryJob.of(person, {"steps": 2, "amount": 0.5, "seed": seed}))


def until_written(seconds: float = 300.0) -> None:
    """Until the volumes are written, which the scene does not show yet."""
    end = time.monotonic() + seconds
    while building._preparing is None or not building._preparing.over:
        assert time.monotonic() < end
        assert follow() is not None
        time.sleep(0.005)


def shown(person) -> dict[str, Path]:
    return {obj.name: volume_path(obj.data) for obj in person.all_objects if obj.type == "VOLUME"}


def on_disk(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if "_humans" in str(path))


def check_whole(person, count: int = COUNT) -> None:
    files = shown(person).values()
    assert len(files) == count
    assert all(path.is_file() for path in files)
    assert all(obj.data.grids.load() for obj in person.all_objects if obj.type == "VOLUME")
    assert person_file(person).parent == next(iter(files)).parent
    assert not list(person_file(person).parent.glob(".*.partial*"))


def check_drawn(person) -> None:
    """Blender has the grids of all volumes in what it draws, also of those that it has missed."""
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    drawn = [obj.evaluated_get(graph).data for obj in person.all_objects if obj.type == "VOLUME"]
    assert [(len(volume.grids), volume.grids.error_message) for volume in drawn] == [(2, "")] * COUNT


def test_an_edit_writes_its_volumes_in_slices(person, monkeypatch):
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    written, write_vdb, ticks = [], volumes.write_vdb, [0]
    monkeypatch.setattr(volumes, "write_vdb", lambda *args: written.append(ticks[0]) or write_vdb(*args))
    vary(person)
    while follow() is not None:
        ticks[0] += 1
    assert len(written) == len(set(written)) == COUNT


def test_nothing_is_shown_until_all_is_in_one_undo_step(varied):
    before = shown(varied)
    assert len(list(folder_of(varied).glob("*/*.vdb"))) == 2 * COUNT
    drive()
    person = humans(bpy.context.scene)[0]
    after = shown(person)
    assert not set(before.values()) & set(after.values())
    bpy.ops.ed.undo()
    assert shown(humans(bpy.context.scene)[0]) == before
    bpy.ops.ed.redo()
    assert shown(humans(bpy.context.scene)[0]) == after
    check_whole(humans(bpy.context.scene)[0])


def test_a_human_removed_meanwhile_is_reported_and_no_file_stays(varied, tmp_path):
    before = set(shown(varied).values())
    remove_human(varied)
    drive()
    assert "was removed during the edit" in error_of("vary")
    assert set((tmp_path / "shot_humans").rglob("*.vdb")) == before


def test_a_person_renamed_meanwhile_is_edited(varied):
    varied.name = "Anna"
    drive()
    assert error_of("vary") == ""
    check_whole(varied)


def test_undo_that_makes_the_person_another_meanwhile_rejects_the_result(person, monkeypatch):
    vary(person)
    drive()
    files = on_disk(folder_of(person).parents[1])
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    vary(person, FINE + 1)
    until_written()
    bpy.ops.ed.undo()
    drive()
    assert "changed during the edit" in error_of("vary")
    person = humans(bpy.context.scene)[0]
    assert on_disk(folder_of(person).parents[1]) == files
    check_whole(person)
    bpy.ops.ed.redo()
    check_whole(humans(bpy.context.scene)[0])


def test_volumes_deleted_and_brought_back_meanwhile_show_what_they_should(person, monkeypatch):
    removed = next(obj for obj in person.all_objects if obj.type == "VOLUME").name
    before = shown(person)
    bpy.data.objects.remove(bpy.data.objects[removed])
    bpy.ops.ed.undo_push(message="a volume deleted")
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    vary(person)
    until_written()
    assert len(list(building._preparing.result.folder.glob("prim_*.vdb"))) == COUNT - 1
    bpy.ops.ed.undo()
    drive()
    person = humans(bpy.context.scene)[0]
    assert not set(shown(person).values()) & set(before.values())
    check_whole(person)


def test_a_volume_deleted_meanwhile_stays_so(varied):
    bpy.data.objects.remove(next(obj for obj in varied.all_objects if obj.type == "VOLUME"))
    drive()
    assert notice_of("vary").startswith("Varied Human in ")
    check_whole(varied, COUNT - 1)


def test_a_person_reshaped_meanwhile_keeps_that_shape(varied):
    armature = next(obj for obj in varied.objects if obj.type == "ARMATURE")
    armature.primdiffusion_human.betas[0] = 1.25
    drive()
    assert armature.primdiffusion_human.betas[0] == pytest.approx(1.25)
    check_whole(varied)


def test_saved_elsewhere_meanwhile_all_of_the_person_goes_along(varied, tmp_path):
    before = set(shown(varied).values())
    (tmp_path / "film").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film" / "other.blend"))
    drive()
    person = humans(bpy.context.scene)[0]
    check_whole(person)
    assert person_file(person).parent == tmp_path / "film" / "other_humans" / "Human" / "0002"
    assert set((tmp_path / "shot_humans").rglob("*.vdb")) == before


def test_a_first_save_meanwhile_takes_the_edited_person_along(addon, tmp_path, monkeypatch):
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(tmp_path / "prepared", COUNT)))
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.primdiffusion.generate(seed=7, steps=1)
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    vary(humans(bpy.context.scene)[0])
    until_written()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "late.blend"))
    drive()
    person = humans(bpy.context.scene)[0]
    check_whole(person)
    bpy.ops.wm.save_mainfile()
    check_whole(person)
    assert person_file(person).parent.parent == folder_of(person) == tmp_path / "late_humans" / "Human"


def test_files_removed_meanwhile_are_written_again(varied):
    bpy.ops.primdiffusion.remove_unused_files()
    drive()
    check_whole(humans(bpy.context.scene)[0])


def test_cancel_leaves_the_person_and_no_files(varied, tmp_path):
    before = shown(varied)
    bpy.ops.primdiffusion.cancel()
    drive()
    assert notice_of("vary") == "Cancelled"
    assert shown(varied) == before
    assert set((tmp_path / "shot_humans").rglob("*.vdb")) == set(before.values())
    check_whole(varied)


def test_cancel_leaves_files_that_undo_and_redo_need(person, monkeypatch):
    vary(person)
    drive()
    bpy.ops.ed.undo()
    person = humans(bpy.context.scene)[0]
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    vary(person)  # to the very person that redo brings
    until_written()
    bpy.ops.primdiffusion.cancel()
    drive()
    bpy.ops.ed.redo()
    check_whole(humans(bpy.context.scene)[0])


def test_another_file_loaded_meanwhile_leaves_no_files(varied, tmp_path):
    before = set(shown(varied).values())
    bpy.ops.wm.read_homefile(use_empty=True)
    drive()
    assert set((tmp_path / "shot_humans").rglob("*.vdb")) == before


def test_disabling_the_extension_leaves_no_files(varied, tmp_path):
    before = set(shown(varied).values())
    blender_primdiffusion.unregister()
    assert set((tmp_path / "shot_humans").rglob("*.vdb")) == before
    blender_primdiffusion.register()


def test_a_full_disk_is_reported_and_leaves_scene_and_disk_as_they_were(person, tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    before, files = shown(person), on_disk(tmp_path)
    monkeypatch.setattr(volumes, "write_vdb", full)
    vary(person)
    drive()
    assert "no space left" in error_of("vary")
    assert shown(person) == before
    assert on_disk(tmp_path) == files


def test_a_failure_in_the_scene_leaves_no_files(varied, tmp_path, monkeypatch):
    before = set(shown(varied).values())
    monkeypatch.setattr("blender_primdiffusion.scene.edit.check_editable", lambda _: 1 / 0)
    drive()
    assert error_of("vary")
    assert set((tmp_path / "shot_humans").rglob("*.vdb")) == before


def test_a_script_that_does_not_wait_for_the_volumes_gets_the_whole_edit(person):
    before = shown(person)
    vary(person)
    while not queue.ready:
        assert follow() is not None
        time.sleep(0.01)
    bpy.ops.primdiffusion.take_result()
    assert follow() is None
    assert not set(shown(person).values()) & set(before.values())
    check_whole(person)


def test_a_person_generated_again_is_written_in_the_thread(person, monkeypatch):
    monkeypatch.setattr(SLICE_SECONDS, 0.0)
    bpy.ops.wm.save_mainfile()
    made = made_from_seed(person)
    for path in state_folder(person).iterdir():
        path.unlink()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (person,) = humans(bpy.context.scene)
    bpy.context.view_layer.update()
    assert not any(obj.data.grids.load() for obj in person.all_objects if obj.type == "VOLUME")
    queue.add(bpy.context, RegenerateJob(HumanTarget.of(person), made))
    until_written()
    drive()
    assert error_of("regenerate") == ""
    assert json.loads(person[MARK])["seed"] == made["seed"]
    check_drawn(person)
    check_whole(person)
