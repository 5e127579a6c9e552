"""The panels Render and Advanced as the user meets them, with the real client and a child that merges small grids."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_files import folder_of, remove_human, sequence_files, volume_path
from jobs_driven import drive, error_of, notice_of, shown, until_running
from support.errors import refused

from blender_primdiffusion.jobs import volumes
from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.jobs.volumes import MergeJob, PoseSnapshot
from blender_primdiffusion.scene.armature import keyframe_poses, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import HumanTarget, humans
from blender_primdiffusion.scene.merged import merged_of, merged_state
from blender_primdiffusion.scene.representation import representation_of
from blender_primdiffusion.scene.splats import SPLATS_AVAILABLE
from blender_primdiffusion.ui import advanced_panel, preferences, render_panel

ops = bpy.ops.primdiffusion


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    """Somebody in shot.blend whom there is to merge."""
    person = build_human(addon, synthetic_shape.write(tmp_path / "human", 6))
    bpy.ops.ed.undo_push(message="a person")
    return person


def raise_left_arm(person, angle: float) -> None:
    turns = np.zeros((24, 3))
    turns[16, 2] = angle
    pose_from_joint_rotations(person, synthetic.axis_angle(turns))
    bpy.context.view_layer.update()


def advanced() -> str:
    """Operators and texts of the panel Advanced, with its sections opened."""
    return " ".join(shown(advanced_panel.PRIMDIFFUSION_PT_advanced, bpy.context, opened=True))


def density_of(person) -> float:
    bpy.utils.expose_bundled_modules()
    import openvdb

    return openvdb.read(str(volume_path(merged_of(person).data)), "density").evalMinMax()[1]


def test_a_merged_pose_is_one_undo_step_and_unmerging_goes_back(person):
    raise_left_arm(person, 0.5)
    bpy.ops.ed.undo_push(message="posed")
    bpy.context.scene.primdiffusion_merging.voxel = 0.02
    assert ops.merge() == {"FINISHED"}
    assert representation_of(person) == "MERGED"
    assert density_of(person) == pytest.approx(10 + 10 * np.sin(0.5), rel=2e-3)
    assert merged_state(merged_of(person)).voxel == pytest.approx(0.02)
    assert "Merged Human at 20 mm" in notice_of("merge")
    bpy.ops.ed.undo()
    person = humans(bpy.context.scene)[0]
    assert (representation_of(person), merged_of(person)) == ("VOLUMES", None)
    bpy.ops.ed.redo()
    person = humans(bpy.context.scene)[0]
    assert representation_of(person) == "MERGED"
    assert ops.merge(what="NOTHING") == {"FINISHED"}
    assert (representation_of(person), merged_of(person)) == ("VOLUMES", None)


@pytest.mark.any_blender
def test_the_panel_reports_a_changed_pose(person):
    raise_left_arm(person, 0.3)
    ops.merge()
    assert not advanced_panel.outdated(person, bpy.context.scene)
    person.location.x = 2  # the merged volume moves along
    bpy.context.view_layer.update()
    assert not advanced_panel.outdated(person, bpy.context.scene)
    raise_left_arm(person, 0.4)
    assert advanced_panel.outdated(person, bpy.context.scene)
    assert "of another pose" in advanced()
    ops.merge()
    assert not advanced_panel.outdated(person, bpy.context.scene)
    assert "of another pose" not in advanced()


def test_a_frame_range_becomes_a_sequence_and_the_scene_stays_at_its_frame(person):
    frames = np.arange(5, 9)
    turns = np.zeros((4, 24, 3))
    turns[:, 16, 2] = 0.2 * np.arange(4)
    keyframe_poses(person, frames, synthetic.axis_angle(turns), np.zeros((4, 3)))
    scene = bpy.context.scene
    scene.frame_set(7)
    scene.frame_start, scene.frame_end, scene.primdiffusion_merging.voxel = 5, 8, 0.02
    assert ops.merge(what="FRAMES") == {"FINISHED"}
    assert scene.frame_current == 7
    volume = merged_of(person).data
    files = sequence_files(volume)
    assert (len(files), volume.is_sequence, volume.frame_start, volume.frame_duration) == (4, True, 5, 4)
    bpy.utils.expose_bundled_modules()
    import openvdb

    found = [openvdb.read(str(path), "density").evalMinMax()[1] for path in files]
    np.testing.assert_allclose(found, 10 + 10 * np.sin(0.2 * np.arange(4)), rtol=2e-3)
    for frame in (5, 6, 8):
        scene.frame_set(frame)
        assert not advanced_panel.outdated(person, scene)
    scene.frame_start, scene.frame_end = 6, 7
    assert ops.merge(what="FRAMES") == {"FINISHED"}
    assert merged_of(person).data.frame_duration == 2
    ops.merge()
    assert not merged_of(person).data.is_sequence


@pytest.mark.any_blender
def test_a_range_that_is_none_is_rejected(person):
    bpy.context.scene.frame_start = bpy.context.scene.frame_end = 7
    with refused(RuntimeError, "7 to 7"):
        ops.merge(what="FRAMES")
    assert merged_of(person) is None


@pytest.mark.any_blender
def test_a_cancelled_sequence_leaves_nothing(person, monkeypatch):
    monkeypatch.setenv("FAKE_ORDER", "takes long")
    moment = PoseSnapshot.capture(person)
    before = sorted(folder_of(person).iterdir())
    queue.add(bpy.context, MergeJob(HumanTarget.of(person), [moment, moment], 0.02, 1))
    until_running()
    queue.cancel()
    drive()
    assert merged_of(person) is None
    assert sorted(folder_of(person).iterdir()) == before


def test_the_frames_of_a_sequence_are_written_one_at_a_tick(person, monkeypatch):
    written, ticks = [], [0]
    write_grid = volumes.write_grid
    monkeypatch.setattr(volumes, "write_grid", lambda *args: written.append(ticks[0]) or write_grid(*args))
    moment = PoseSnapshot.capture(person)
    queue.add(bpy.context, MergeJob(HumanTarget.of(person), [moment] * 5, 0.02, 1))
    while follow() is not None:
        ticks[0] += 1
    assert len(written) == len(set(written)) == 5
    assert len(sequence_files(merged_of(person).data)) == 5


@pytest.mark.any_blender
def test_a_human_removed_meanwhile_is_not_merged(person):
    queue.add(bpy.context, MergeJob(HumanTarget.of(person), [PoseSnapshot.capture(person)], 0.02))
    remove_human(person)
    drive()
    assert "was removed" in error_of("merge")


@pytest.mark.any_blender
def test_set_representation_reports_what_stands_in_the_way(person):
    with refused(RuntimeError, "Merge"):
        ops.set_representation(representation="MERGED")
    with refused(RuntimeError, "merged"):
        ops.merge(what="NOTHING")
    with refused(RuntimeError, "Nobody"):
        ops.set_representation(representation="VOLUMES", human="Nobody")


def test_panels_show_representations_and_warnings(person):
    context = bpy.context
    assert advanced().count("primdiffusion.merge") == 2
    assert advanced().count("set_representation") == 1 + SPLATS_AVAILABLE
    ops.merge()
    assert advanced().count("set_representation") == 2 + SPLATS_AVAILABLE
    ops.merge(what="NOTHING")
    assert shown(render_panel.PRIMDIFFUSION_PT_render, context).count("primdiffusion.set_up_engine") == 2


def test_setting_up_cycles_leaves_camera_world_and_bounces_between_objects(person):
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Mine", bpy.data.cameras.new("Mine"))
    scene.collection.objects.link(camera)
    scene.camera, scene.cycles.max_bounces = camera, 7
    world = scene.world
    assert ops.set_up_engine(engine="CYCLES") == {"FINISHED"}
    assert (scene.render.engine, scene.camera, scene.world, scene.cycles.max_bounces) == ("CYCLES", camera, world, 7)
    assert scene.cycles.transparent_max_bounces == 1024
    assert scene.view_settings.view_transform == "Standard"
    assert scene.cycles.volume_biased
    assert ops.set_up_engine() == {"FINISHED"}
    assert (scene.render.engine, scene.camera) == ("PRIMDIFFUSION", camera)
    scene.render.engine = "CYCLES"


@pytest.mark.any_blender
def test_before_the_backend_is_set_up_cycles_alone_is_offered_and_nothing_is_merged(person, monkeypatch):
    monkeypatch.setattr(render_panel, "known", lambda: preferences.Known("absent", ""))
    assert shown(render_panel.PRIMDIFFUSION_PT_render, bpy.context).count("primdiffusion.set_up_engine") == 1
    assert ops.set_up_engine(engine="CYCLES") == {"FINISHED"}
    assert merged_of(person) is None


@pytest.mark.any_blender
def test_our_engine_leads_to_the_set_up_where_no_backend_would_render(person, monkeypatch):
    monkeypatch.setattr(preferences, "known", lambda: preferences.Known("absent", "The backend is not set up yet"))
    bpy.context.scene.render.engine = "PRIMDIFFUSION"
    for panel in (render_panel.PRIMDIFFUSION_PT_render, render_panel.PRIMDIFFUSION_PT_marching):
        assert "The backend is not set up yet" in shown(panel, bpy.context)
    bpy.context.scene.render.engine = "CYCLES"
    assert "not set up" not in shown(render_panel.PRIMDIFFUSION_PT_render, bpy.context)
