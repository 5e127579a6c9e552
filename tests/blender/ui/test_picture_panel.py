"""Human from Picture as the user meets it, with the real client and a child that moves an arm and the pelvis."""

from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from blender_primdiffusion.files.picture_files import write_png
from human_files import person_file
from jobs_driven import drive, error_of, notice_of, shown, until_running
from support.errors import refused
from support.fake_child import request_of

from blender_primdiffusion.capture.cameras import OpenImageIO, picture_view, pictures_of, stored_turned
from blender_primdiffusion.jobs import from_picture
from blender_primdiffusion.jobs.from_picture import PictureJob, PictureTask
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.jobs.variations import backs
from blender_primdiffusion.motion.poses import take_world_posture, world_posture
from blender_primdiffusion.scene.convention import points_to_backend
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.shape import betas_of
from blender_primdiffusion.ui.picture_panel import PRIMDIFFUSION_OT_choose_picture, PRIMDIFFUSION_PT_human_from_picture

pytestmark = pytest.mark.any_blender
WIDTH, HEIGHT = 60, 80
LEFT_SHOULDER = 16
MOVED = np.array([0.25, 0, 0])
"""By the fake child."""


@pytest.fixture
def picture(tmp_path) -> Path:
    write_png(tmp_path / "anna.png", np.full((HEIGHT, WIDTH, 4), 200, np.uint8))
    return tmp_path / "anna.png"


@pytest.fixture
def chosen(addon, picture, monkeypatch):
    """The scene with the picture's camera; humans count as on the default body, though tests have a smaller one."""
    monkeypatch.setattr(from_picture, "on_own_body", lambda _: False)
    assert bpy.ops.primdiffusion.choose_picture(filepath=str(picture)) == {"FINISHED"}
    return addon


def a_human() -> bpy.types.Object:
    bpy.ops.primdiffusion.generate(seed=100)
    return humans(bpy.context.scene)[0]


def focal_length(context) -> float:
    """Of the scene's camera, pixels."""
    camera = context.scene.camera
    return picture_view(context, camera, pictures_of(camera)[0]).intrinsics[0, 0]


def joint_places(armature) -> np.ndarray:
    bpy.context.view_layer.update()
    heads = [armature.matrix_world @ bone.head for bone in armature.pose.bones if bone.name in ("pelvis", "left_wrist")]
    return points_to_backend(np.array(heads))


def test_a_picture_becomes_the_background_of_a_camera_of_its_size(chosen, picture):
    camera = chosen.scene.camera
    image = pictures_of(camera)[0]
    assert Path(bpy.path.abspath(image.filepath)) == picture
    render = chosen.scene.render
    assert (render.resolution_x, render.resolution_y, render.resolution_percentage) == (WIDTH, HEIGHT, 100)
    view = picture_view(chosen, camera, image)
    assert view.intrinsics[:2, 2] == pytest.approx([WIDTH / 2, HEIGHT / 2])
    assert 2 * np.degrees(np.arctan(HEIGHT / 2 / view.intrinsics[1, 1])) == pytest.approx(45, abs=1e-3)
    assert view.rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-6)
    bpy.ops.ed.undo_push(message="after")


def test_a_posture_is_taken_as_it_was_given(addon):
    armature = a_human()
    armature.rotation_mode = "XYZ"
    armature.rotation_euler, armature.location = (0.1, -0.2, 2.0), (1.0, 2.0, 0.5)
    bpy.context.view_layer.update()
    before = joint_places(armature)
    pose, translation = world_posture(armature)
    armature.location = (0, 0, 3)
    armature.rotation_euler = (0.3, 0, 0)
    bpy.context.view_layer.update()
    take_world_posture(armature, pose, translation)
    bpy.context.view_layer.update()
    again, moved = world_posture(armature)
    assert again == pytest.approx(pose, abs=1e-5)
    assert moved == pytest.approx(translation, abs=1e-5)
    assert joint_places(armature) == pytest.approx(before, abs=1e-5)
    armature.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    with refused(ValueError, armature.name, "scale"):
        world_posture(armature)


def test_fit_moves_the_human_and_the_camera_in_one_step_of_undo(chosen):
    person = a_human()
    armature, focal = person, focal_length(chosen)
    pose, translation = world_posture(armature)
    betas = np.array(betas_of(person))
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.primdiffusion.human_from_picture(only_fit=True, human=person.name) == {"FINISHED"}
    bpy.context.view_layer.update()
    found, moved = world_posture(armature)
    assert found[LEFT_SHOULDER, 2] == pytest.approx(pose[LEFT_SHOULDER, 2] - 0.5, abs=1e-5)
    assert moved == pytest.approx(translation + MOVED, abs=1e-5)
    assert np.array(betas_of(person)) == pytest.approx(betas + np.eye(10)[1] * 0.5, abs=1e-6)
    assert focal_length(chosen) == pytest.approx(1.1 * focal, rel=1e-4)
    assert notice_of("fit_picture").startswith("Fitted (fit 92 %) in ")
    assert "A guess." in notice_of("fit_picture")
    assert len(humans(chosen.scene)) == 1
    bpy.ops.ed.undo()
    armature = humans(bpy.context.scene)[0]
    assert world_posture(armature)[1] == pytest.approx(translation, abs=1e-5)


def test_handles_are_baked_before_a_human_is_fitted(chosen):
    person = a_human()
    assert bpy.ops.primdiffusion.add_handles(human=person.name) == {"FINISHED"}
    for only_fit in (True, False):
        with refused(RuntimeError, person.name, "IK handles"):
            bpy.ops.primdiffusion.human_from_picture(only_fit=only_fit, human=person.name)


def test_make_human_starts_from_a_standing_one_where_none_is_posed(chosen, picture, tmp_path):
    mask = tmp_path / "mask.png"
    write_png(mask, np.full((HEIGHT, WIDTH), 255, np.uint8))
    settings = chosen.scene.primdiffusion_picture
    settings.mask, settings.backs = str(mask), 0
    camera = chosen.scene.camera
    before = np.array(camera.matrix_world.translation)
    assert bpy.ops.primdiffusion.human_from_picture() == {"FINISHED"}
    (person,) = humans(chosen.scene)
    sent = request_of(person_file(person))
    assert (sent["pictures"], sent["masks"]) == ([str(picture)], [str(mask)])
    assert "backs" not in sent
    assert Path(sent["cameras"]).name == "cameras.json"
    assert "pose" not in sent
    armature = person
    pose, translation = world_posture(armature)
    assert pose[LEFT_SHOULDER] == pytest.approx([0, 0, -0.5], abs=1e-5)
    assert np.array(armature.matrix_world.translation) == pytest.approx(np.zeros(3), abs=1e-5)  # on the floor
    moved = np.array(camera.matrix_world.translation) - before
    assert points_to_backend(moved) == pytest.approx(translation - MOVED, abs=1e-5)  # the camera sees it as fitted


def test_make_human_stands_where_the_posed_one_was_which_is_hidden(chosen):
    posed = a_human()
    assert bpy.ops.primdiffusion.human_from_picture(human=posed.name) == {"FINISHED"}
    made = next(person for person in humans(chosen.scene) if person != posed)
    assert "pose" in request_of(person_file(made))
    assert posed.hide_viewport
    assert posed.hide_render
    assert world_posture(made)[1] == pytest.approx(world_posture(posed)[1] + MOVED, abs=0.02)


def test_one_of_the_backs_is_shown_in_place_and_undone_in_one_step(chosen):
    chosen.scene.primdiffusion_picture.backs = 3
    a_human().select_set(False)
    bpy.ops.primdiffusion.human_from_picture()
    person = bpy.context.view_layer.objects.active
    name = person.name
    assert request_of(person_file(person))["backs"] == 3
    texts = shown(PRIMDIFFUSION_PT_human_from_picture, chosen)
    assert texts[texts.index("Other backs") + 1 :] == ["primdiffusion.human_from_picture"] * 3
    before, files = person_file(person).read_bytes(), [one.person.read_bytes() for one in backs.variations]
    bpy.ops.ed.undo_push(message="before")
    pose, translation = world_posture(person)
    assert bpy.ops.primdiffusion.human_from_picture(back=2) == {"FINISHED"}
    person = bpy.data.objects[name]
    assert person_file(person).read_bytes() == files[1] != before
    after = world_posture(person)
    assert after[0] == pytest.approx(pose, abs=1e-5)
    assert after[1] == pytest.approx(translation, abs=1e-5)
    bpy.ops.ed.undo()
    assert person_file(bpy.data.objects[name]).read_bytes() == before
    with refused(RuntimeError, "no such back"):
        bpy.ops.primdiffusion.human_from_picture(back=4)
    bpy.ops.wm.read_homefile(use_empty=True)
    assert not backs.variations
    with refused(RuntimeError, "no such back"):
        bpy.ops.primdiffusion.human_from_picture(back=1)


@pytest.fixture
def three(chosen, picture):
    """Three pictures chosen at once, as in the file browser."""
    for name in ("side.png", "back.png"):
        write_png(picture.with_name(name), np.full((HEIGHT, WIDTH, 4), 90, np.uint8))
    names = [{"name": name} for name in ("anna.png", "side.png", "back.png")]
    assert bpy.ops.primdiffusion.choose_picture(directory=str(picture.parent), files=names) == {"FINISHED"}
    return chosen


def test_several_pictures_have_one_camera_and_a_pose_each(three, picture):
    images = pictures_of(three.scene.camera)
    assert [Path(image.filepath).name for image in images] == ["anna.png", "side.png", "back.png"]
    backgrounds = three.scene.camera.data.background_images
    assert [each.show_background_image for each in backgrounds] == [True, False, False]
    three.scene.primdiffusion_picture.mask = str(picture)
    bpy.ops.primdiffusion.human_from_picture()
    (person,) = humans(three.scene)
    sent = request_of(person_file(person))
    assert [Path(path).name for path in sent["pictures"]] == ["anna.png", "side.png", "back.png"]
    assert not {"cameras", "pose", "masks"} & set(sent)
    assert world_posture(person)[0][LEFT_SHOULDER, 2] == pytest.approx(-0.5, abs=1e-5)
    three.scene.frame_set(2)
    assert world_posture(person)[0][LEFT_SHOULDER, 2] == pytest.approx(0, abs=1e-5)
    shoulder = person.pose.bones["left_shoulder"]
    shoulder.rotation_quaternion = (np.cos(0.3), 0, 0, np.sin(0.3))
    shoulder.keyframe_insert("rotation_quaternion", frame=2)
    wanted = world_posture(person)[0][LEFT_SHOULDER]
    bpy.ops.primdiffusion.human_from_picture(human=person.name)
    made = next(one for one in humans(three.scene) if one != person)
    assert Path(request_of(person_file(made))["pose"]).suffix == ".npz"
    three.scene.frame_set(2)
    assert world_posture(made)[0][LEFT_SHOULDER] == pytest.approx(wanted, abs=1e-4)


def test_too_many_pictures_a_damaged_one_and_one_that_is_stored_turned_leave_nothing(addon, tmp_path, picture):
    turned, spec = tmp_path / "turned.jpg", OpenImageIO.ImageSpec(4, 4, 3, "uint8")
    spec.attribute("Orientation", 6)
    output = OpenImageIO.ImageOutput.create(str(turned))
    assert output.open(str(turned), spec)
    output.write_image(np.zeros((4, 4, 3), np.uint8))
    output.close()
    assert stored_turned(turned)
    assert not stored_turned(picture)
    with refused(RuntimeError, "turned.jpg"):
        bpy.ops.primdiffusion.choose_picture(filepath=str(turned))
    (picture.parent / "noise.png").write_bytes(b"no picture")
    names = [{"name": name} for name in ("anna.png", "noise.png")]
    with refused(RuntimeError, "noise.png"):
        bpy.ops.primdiffusion.choose_picture(directory=str(picture.parent), files=names)
    with refused(RuntimeError, "9 pictures", "up to 8"):
        bpy.ops.primdiffusion.choose_picture(directory=str(picture.parent), files=[{"name": "anna.png"}] * 9)
    assert not bpy.data.images
    assert not bpy.data.cameras


def test_a_human_with_lowered_arms_is_added_to_a_picture_without_alpha(addon, tmp_path, picture):
    write_png(tmp_path / "plain.png", np.full((HEIGHT, WIDTH, 3), 200, np.uint8))
    addon.scene.primdiffusion_picture.mask = str(picture)
    bpy.ops.primdiffusion.choose_picture(filepath=str(tmp_path / "plain.png"))
    assert not humans(addon.scene), "the mask marks the person"
    addon.scene.primdiffusion_picture.mask = ""
    for _ in range(2):
        bpy.ops.primdiffusion.choose_picture(filepath=str(tmp_path / "plain.png"))
    (person,) = humans(addon.scene)
    assert bpy.context.view_layer.objects.active == person
    bpy.context.view_layer.update()
    wrist = joint_places(person)[1]
    view = picture_view(addon, addon.scene.camera, pictures_of(addon.scene.camera)[0])
    pixels, _ = view.project(joint_places(person))
    assert ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(), "the human is in the picture"
    assert wrist[1] < joint_places(person)[0][1] + 0.2


def test_without_picture_human_or_equal_size_there_is_a_sentence(addon, picture):
    with refused(RuntimeError, "Choose Picture"):
        bpy.ops.primdiffusion.human_from_picture()
    bpy.ops.primdiffusion.choose_picture(filepath=str(picture))
    with refused(RuntimeError, "Select the human"):
        bpy.ops.primdiffusion.human_from_picture(only_fit=True)
    person = a_human()
    with refused(RuntimeError, person.name, "body"):
        bpy.ops.primdiffusion.human_from_picture(human=person.name)
    addon.scene.render.resolution_x = 99
    with refused(RuntimeError, "99 x 80", "60 x 80"):
        bpy.ops.primdiffusion.human_from_picture()
    with refused(RuntimeError, "Choose a picture"):
        bpy.ops.primdiffusion.choose_picture()


def test_a_picture_dropped_onto_the_view_is_chosen_while_the_tab_is_open(addon):
    handler = bpy.types.PRIMDIFFUSION_FH_picture
    assert handler.bl_import_operator == PRIMDIFFUSION_OT_choose_picture.bl_idname
    assert set(handler.bl_file_extensions.split(";")) == {".png", ".jpg", ".jpeg"}

    def taken(area: str, tab: str, sidebar: bool = True) -> bool:
        regions = [SimpleNamespace(type="WINDOW"), SimpleNamespace(type="UI", active_panel_category=tab)]
        space = SimpleNamespace(show_region_ui=sidebar)
        return handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type=area, regions=regions), space_data=space))

    assert taken("VIEW_3D", "PrimDiffusion")
    assert not taken("VIEW_3D", "Item")
    assert not taken("VIEW_3D", "PrimDiffusion", sidebar=False)
    assert not taken("IMAGE_EDITOR", "PrimDiffusion")


def test_progress_is_shown_and_cancel_leaves_no_human(chosen, monkeypatch):
    monkeypatch.setenv("FAKE_ORDER", "takes long")
    queue.add(chosen, PictureJob(PictureTask.of(chosen, "", None)))
    until_running()
    texts = shown(PRIMDIFFUSION_PT_human_from_picture, chosen)
    assert texts[:2] == ["primdiffusion.choose_picture", "anna.png"]
    assert "primdiffusion.cancel" in texts
    bpy.ops.primdiffusion.cancel()
    drive()
    assert (error_of("from_picture"), notice_of("from_picture")) == ("", "Cancelled")
    assert not humans(chosen.scene)


@pytest.mark.slow
def test_the_real_child_makes_a_human_of_a_picture(real_child, tmp_path):
    pixels = np.zeros((120, 80, 4), np.uint8)
    pixels[10:110, 34:46] = pixels[24:30, 14:66] = [180, 60, 40, 255]
    write_png(tmp_path / "anna.png", pixels)
    bpy.ops.primdiffusion.choose_picture(filepath=str(tmp_path / "anna.png"))
    assert bpy.ops.primdiffusion.human_from_picture() == {"FINISHED"}
    (person,) = humans(real_child.scene)
    view = picture_view(real_child, real_child.scene.camera, pictures_of(real_child.scene.camera)[0])
    pixels, depth = view.project(joint_places(person))
    assert (depth > 1).all()
    assert ((pixels > 5) & (pixels < [75, 115])).all()
