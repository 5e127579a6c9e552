"""Volumes are written when they are to be seen: by a job for views, before renders by another engine."""

import bpy
import numpy as np
import pytest
import synthetic_shape
from human_files import copy_of, folder_of, forget_session_files, volume_path
from jobs_driven import error_of, notice_of
from oracle import evaluated_matrices
from support.errors import refused

import blender_primdiffusion
from benchmarks.cycles_preview import setup_cycles_preview
from blender_primdiffusion.engine.engine import ENGINE
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.jobs.volumes import VolumesJob, faults, write_before_rendering
from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import HumanTarget, humans
from blender_primdiffusion.scene.merged import merged_of
from blender_primdiffusion.scene.representation import in_viewport, representation_of, set_representation
from blender_primdiffusion.scene.volume_nodes import are_written, volumes_of

ops = bpy.ops.primdiffusion
COUNT = 12


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    source = synthetic_shape.write(tmp_path / "human", COUNT)
    monkeypatch.setenv("FAKE_HUMAN", str(source))
    person = build_human(addon, source)
    bpy.ops.ed.undo_push(message="a person")
    return person


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.fixture
def full_disk(monkeypatch):
    monkeypatch.setattr(volumes, "write_vdb", full)
    return monkeypatch


def drawn() -> int:
    bpy.context.view_layer.update()
    return sum(one.object.type == "VOLUME" for one in bpy.context.evaluated_depsgraph_get().object_instances)


def test_shown_in_viewports_they_are_written_and_drawn_and_undo_hides_them(person):
    assert ops.volumes_in_viewport() == {"FINISHED"}
    assert drawn() == COUNT
    assert "3D views show the volumes" in notice_of("volumes")
    bpy.ops.ed.undo()
    assert drawn() == 0
    bpy.ops.ed.redo()
    assert drawn() == COUNT
    assert ops.volumes_in_viewport() == {"FINISHED"}
    assert drawn() == 0


@pytest.mark.any_blender
def test_a_cancelled_job_keeps_what_is_written_and_shows_nothing(person, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.jobs.volumes.SLICE_S", 1e-3)
    queue.add(bpy.context, VolumesJob(HumanTarget.of(person)))
    queue.tick()
    queue.tick()
    assert queue.advancing
    queue.cancel()
    assert notice_of("volumes") == "Cancelled"
    assert not in_viewport(person)
    assert not list(folder_of(person).glob(".*.partial*"))


@pytest.mark.any_blender
def test_a_full_disk_is_told_and_nothing_is_shown(person, full_disk):
    with refused(RuntimeError, "No space left"):
        ops.volumes_in_viewport()
    assert "No space left" in error_of("volumes")
    assert not in_viewport(person)
    assert not list(folder_of(person).glob("*.vdb"))
    full_disk.undo()
    assert ops.volumes_in_viewport() == {"FINISHED"}
    assert drawn() == COUNT


def test_an_edit_shows_its_own_volumes_at_once(person):
    ops.volumes_in_viewport()
    before = folder_of(person)
    assert ops.vary(seed=8) == {"FINISHED"}
    assert folder_of(person) != before
    assert drawn() == COUNT
    bpy.ops.ed.undo()
    assert folder_of(humans(bpy.context.scene)[0]) == before
    assert drawn() == COUNT


def test_a_render_by_another_engine_has_all_volumes(person):
    bpy.context.scene.render.engine = ENGINE
    write_before_rendering(bpy.context.scene)
    assert not are_written(person)
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    write_before_rendering(bpy.context.scene)
    assert are_written(person)


def test_the_first_picture_by_cycles_shows_the_human(person, tmp_path):
    scene = bpy.context.scene
    setup_cycles_preview(scene, size=16)
    scene.render.filepath = str(tmp_path / "picture.png")
    bpy.ops.render.render(write_still=True)
    assert are_written(person)
    picture = bpy.data.images.load(scene.render.filepath)
    assert max(list(picture.pixels)[3::4]) > 0.2


@pytest.mark.any_blender
def test_what_a_render_cannot_write_is_told_and_forgotten_when_it_is_written_or_the_extension_disabled(
    person, full_disk
):
    twin = copy_of(person)
    for _ in range(2):
        write_before_rendering(bpy.context.scene)
    assert "No space left" in faults.text
    full_disk.undo()
    write_before_rendering(bpy.context.scene)
    assert faults.text == ""
    assert are_written(person)
    assert are_written(twin)
    assert folder_of(twin) == folder_of(person), "once for both"
    faults.report("the human 'Anna' cannot be drawn")
    blender_primdiffusion.unregister()
    assert faults.text == ""


def test_cycles_merges_humans_that_stand_still_and_leaves_those_that_move(person):
    moving = copy_of(person)
    moving.animation_data_create().action = bpy.data.actions.new("Walk")
    assert ops.set_up_engine(engine="CYCLES") == {"FINISHED"}
    assert [representation_of(one) for one in (person, moving)] == ["MERGED", "VOLUMES"]
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"


def test_volumes_that_an_opened_file_shows_are_hidden_until_they_are_written_again(person):
    ops.volumes_in_viewport()
    bpy.ops.wm.save_mainfile()
    forget_session_files()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (human,) = humans(bpy.context.scene)
    assert drawn() == 0
    assert not in_viewport(human)
    write_before_rendering(bpy.context.scene)
    volumes_of(human).hide_viewport = False
    assert drawn() == COUNT, "no view has looked for the files before they were there"


@pytest.mark.any_blender
def test_an_edit_on_a_full_disk_is_made_and_its_missing_volumes_are_told(person, monkeypatch):
    ops.volumes_in_viewport()
    before = folder_of(person)
    with monkeypatch.context() as patched:
        patched.setattr(volumes, "write_vdb", full)
        assert ops.vary(seed=8) == {"FINISHED"}
    assert folder_of(person) != before
    assert "No space left" in faults.text
    write_before_rendering(bpy.context.scene)
    assert are_written(person)


def test_volumes_that_renders_hide_are_not_written_and_those_of_other_scenes_are(person):
    volumes_of(person).hide_render = True
    write_before_rendering(bpy.context.scene)
    assert not are_written(person)
    volumes_of(person).hide_render = False
    bpy.ops.scene.new(type="EMPTY")
    write_before_rendering(bpy.context.scene)  # it may hold an instance of the human
    assert are_written(person)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_merged_by_the_real_child_a_human_fills_the_space_of_the_volumes_on_the_surface(real_child):
    real_child.scene.primdiffusion.steps = 2
    ops.generate(seed=1)
    (person,) = humans(real_child.scene)
    turns = np.tile(np.eye(3), (24, 1, 1))
    turns[16] = [[np.cos(1.2), np.sin(1.2), 0], [-np.sin(1.2), np.cos(1.2), 0], [0, 0, 1]]
    pose_from_joint_rotations(person, turns)
    bpy.context.scene.primdiffusion_merging.voxel = 0.0005
    with refused(RuntimeError, "choose", "mm or more"):
        ops.merge()
    bpy.context.scene.primdiffusion_merging.voxel = 0.02
    assert ops.merge() == {"FINISHED"}
    bpy.utils.expose_bundled_modules()
    import openvdb

    grid = openvdb.read(str(volume_path(merged_of(person).data)), "density")
    box = np.array([grid.transform.indexToWorld(corner) for corner in grid.evalActiveVoxelBoundingBox()])
    set_representation(person, "VOLUMES")
    places_of = evaluated_matrices(person)[:, :3, 3] - np.array(person.matrix_world)[:3, 3]
    assert len(places_of) == 1024
    centres = np.array([np.min(places_of, 0), np.max(places_of, 0)])
    assert (box[0] < centres[0] + 0.02).all()
    assert (box[1] > centres[1] - 0.02).all()
    np.testing.assert_allclose(box, centres, atol=0.15)
