"""People and poses as assets: marked with words and a picture, brought into other files with everything they need."""

from __future__ import annotations

import json
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
import synthetic
from blender_primdiffusion.formats.poses.rotation import from_axis_angle
from human_files import lose_data, person_file
from support.errors import refused
from support.fake_child import PICTURE

from blender_primdiffusion.jobs.assets import SIDE, clay_figure, picture_of_file
from blender_primdiffusion.motion.pose_library import builtin_poses, current_pose
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.human import MARK, humans, parts_of
from blender_primdiffusion.ui import export_panel

ops = bpy.ops.primdiffusion


@pytest.fixture
def person(addon):
    ops.generate(seed=7, steps=1, attributes="sex=female, height=1.7")
    (person,) = humans(addon.scene)
    made = json.loads(person[MARK])
    person[MARK] = json.dumps({**made, "attributes": {"sex": "female", "height": 1.7}})
    return person


def waving() -> np.ndarray:
    rotations = np.tile(np.eye(3), (24, 1, 1))
    rotations[17] = synthetic.axis_angle(np.array([0.0, 0.0, -1.0]))
    return rotations


def preview(asset: bpy.types.ID) -> np.ndarray:
    pixels = np.empty(SIDE * SIDE * 4, np.float32)
    asset.preview.image_pixels_float.foreach_get(pixels)
    return pixels.reshape(SIDE, SIDE, 4)


def rendered(tmp_path) -> dict:
    return json.loads((tmp_path / "prepared" / "rendered.json").read_text())


def test_a_human_becomes_an_asset_with_tags_and_a_preview(person, tmp_path):
    assert ops.mark_as_asset() == {"FINISHED"}
    about = person.asset_data
    assert about.description == "Generated human, seed 0, sex female, height 1.7"
    assert {tag.name for tag in about.tags} == {"human", "female"}
    assert about.author == ""
    assert np.abs(preview(person) - picture_of_file(PICTURE)).max() < 0.01
    asked = rendered(tmp_path)
    assert asked["human"] == str(person_file(person))
    assert (len(asked["pose"]), asked["pose"][16 * 3 + 2]) == (72, -1.15)


def test_a_given_preview_needs_no_backend(person, tmp_path):
    assert ops.mark_as_asset(picture=str(PICTURE)) == {"FINISHED"}
    assert preview(person).max() > 0
    assert not (tmp_path / "prepared" / "rendered.json").exists()


def test_one_undo_makes_it_an_ordinary_collection_again(person):
    bpy.ops.ed.undo_push(message="before")
    ops.mark_as_asset(human="Human")
    bpy.ops.ed.undo()
    assert humans(bpy.context.scene)[0].asset_data is None
    bpy.ops.ed.redo()
    assert humans(bpy.context.scene)[0].asset_data is not None


def test_unmarking_leaves_the_person(person):
    ops.mark_as_asset(picture=str(PICTURE))
    with bpy.context.temp_override(id=person):  # as the panel's button
        assert bpy.ops.asset.clear_single() == {"FINISHED"}
    assert person.asset_data is None
    assert humans(bpy.context.scene) == [person]


@pytest.mark.parametrize("link", [False, True])
def test_another_file_finds_the_volumes_of_a_person_it_appends_or_links(person, tmp_path, link):
    ops.mark_as_asset(picture=str(PICTURE))
    bpy.ops.wm.save_mainfile()
    library = bpy.data.filepath
    (tmp_path / "elsewhere").mkdir()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elsewhere" / "other.blend"))
    operator = bpy.ops.wm.link if link else bpy.ops.wm.append
    operator(directory=f"{library}/Collection/", filename="Human", **({"instance_collections": False} if link else {}))
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (person,) = humans(bpy.context.scene)
    volumes = [obj.data for obj in parts_of(person) if obj.type == "VOLUME"]
    assert len(volumes) == 8
    assert person_file(person).is_file()
    assert person.pose.bones["head"]
    assert (person.library is not None) == link
    if link:
        with refused(RuntimeError, "linked"):
            ops.mark_as_asset(picture=str(PICTURE))
        with bpy.context.temp_override(id=person):
            assert not bpy.ops.asset.clear_single.poll()


def test_a_pose_becomes_an_action_that_gives_it_to_any_human(person, tmp_path):
    armature = person
    pose_from_joint_rotations(armature, waving())
    assert ops.mark_as_asset(what="POSE", name="Waving") == {"FINISHED"}
    action = bpy.data.actions["Waving"]
    assert {tag.name for tag in action.asset_data.tags} == {"pose", "Human"}
    assert preview(action).max() > 0
    assert tuple(action.frame_range) == (1, 1)
    assert armature.animation_data is None
    np.testing.assert_allclose(np.array(rendered(tmp_path)["pose"]).reshape(24, 3)[17], [0, 0, -1], atol=1e-5)
    ops.generate(seed=8, steps=1)
    other = humans(bpy.context.scene)[1]
    other.pose.apply_pose_from_action(action)
    np.testing.assert_allclose(current_pose(other)[0], waving(), atol=1e-4)


def test_marking_a_pose_leaves_the_active_action(person):
    armature = person
    armature.keyframe_insert("location", frame=3)
    action, slot = armature.animation_data.action, armature.animation_data.action_slot
    ops.mark_as_asset(what="POSE", picture=str(PICTURE))
    assert (armature.animation_data.action, armature.animation_data.action_slot) == (action, slot)
    assert bpy.data.actions["Pose"].asset_data is not None


def test_the_built_in_poses_become_a_library_and_the_open_file_stays(addon, tmp_path):
    libraries = addon.preferences.filepaths.asset_libraries
    before, objects = len(libraries), len(bpy.data.objects)
    folder = tmp_path / "Posen für alle"
    for _ in range(2):
        assert ops.make_pose_assets(directory=str(folder)) == {"FINISHED"}
    assert [path.name for path in folder.iterdir()] == ["poses.blend"]
    assert (len(bpy.data.objects), len(bpy.data.actions), len(bpy.data.armatures)) == (objects, 0, 0)
    assert len(libraries) == before + 1
    with bpy.data.libraries.load(str(folder / "poses.blend"), assets_only=True) as (there, wanted):
        assert len(there.actions) == len(builtin_poses())
        wanted.actions = list(there.actions)
    for action in bpy.data.actions:
        assert action.asset_data.description.endswith("a built-in pose")
        assert preview(action)[..., 3].mean() > 0.02
    ops.generate(seed=7, steps=1)
    armature = humans(addon.scene)[0]
    name, pose = list(builtin_poses().items())[-1]
    armature.pose.apply_pose_from_action(bpy.data.actions[name[:1].upper() + name[1:]])
    turned = np.einsum("jki,jkl->jil", from_axis_angle(pose), current_pose(armature)[0])
    assert np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)).max() < 0.2  # other rest bones
    libraries.remove(libraries[len(libraries) - 1])


def test_what_cannot_be_an_asset_is_reported(addon, tmp_path):
    with refused(RuntimeError, "human"):
        ops.mark_as_asset()
    ops.generate(seed=7, steps=1)
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "file").write_text("")
    rejected = {
        "cannot be read as a picture": lambda: ops.mark_as_asset(picture=str(tmp_path / "text.png")),
        "cannot be read as a picture:": lambda: ops.mark_as_asset(what="POSE", picture="/nowhere.png"),
        "'Eve' is not in the scene": lambda: ops.mark_as_asset(human="Eve"),
        "[Nn]ot a directory|File exists": lambda: ops.make_pose_assets(directory=str(tmp_path / "file" / "deeper")),
    }
    for sentence, call in rejected.items():
        with pytest.raises(RuntimeError, match=sentence):
            call()
    assert not bpy.data.actions
    (person,) = humans(addon.scene)
    assert person.asset_data is None
    lose_data(person)
    with refused(RuntimeError, "Human"):
        ops.mark_as_asset()


def test_the_panel_offers_what_makes_sense(person):
    def buttons() -> list[str]:
        layout = MagicMock()
        layout.row.return_value = layout
        export_panel._draw_assets(layout, bpy.context)
        if layout.context_pointer_set.called:
            layout.context_pointer_set.assert_called_once_with("id", person)
        return [call.args[0] for call in layout.operator.call_args_list]

    of_pose = ["primdiffusion.mark_as_asset", "primdiffusion.make_pose_assets"]
    assert buttons() == ["primdiffusion.mark_as_asset", *of_pose]
    ops.mark_as_asset(picture=str(PICTURE))
    assert buttons() == ["asset.clear_single", *of_pose]


def test_a_clay_figure_is_within_its_picture_and_lit_from_above():
    figure = clay_figure(synthetic.joints())
    assert figure[..., 3].max() == 1
    assert figure[[0, -1], :, 3].max() == figure[:, [0, -1], 3].max() == 0
    rows = np.flatnonzero(figure[..., 3].any(1))
    head = figure[rows[-12] :, :, 0][figure[rows[-12] :, :, 3] > 0]
    assert head.mean() > figure[..., 0][figure[..., 3] > 0].mean()
