"""Postures: found again by the fit, upright, framed by masks, and kept in files."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.photograph import Photograph
from primdiffusion.capture.reader import Window
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import STANDARD_SHAPES, DiffusionModel
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.human import Human, framing, place, pose_body
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.reconstruction import from_pictures
from primdiffusion.reconstruction.posture_fit import Posture, PostureFit, Stage, deviations, each, outline_error
from primdiffusion.reconstruction.posture_start import (
    cameras_of,
    framed,
    place_in_camera,
    read_cameras,
    read_posture,
    repeated,
    standing,
    turned_to_camera,
    views_of,
    write_posture,
)
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import march
from support.errors import refused
from support.tiny import tiny_model

MODEL = tiny_model()
PAYLOAD = MODEL.decode(MODEL.denoiser.prior.mean).map(torch.Tensor.clone)


def seen(posture: Posture) -> list[PosedView]:
    """Pictures of a posture by its own cameras."""
    targets = []
    for frames, camera in zip(posture.frames(), each(posture.camera), strict=True):
        with torch.no_grad():
            picture = march(Primitives.place(frames, PAYLOAD), camera)
        targets.append(PosedView(frames, camera, torch.cat([picture.rgb, picture.alpha[..., None]], -1)))
    return targets


def a_posture(count: int = 1, size: int = 64) -> Posture:
    pose, betas = repeated(standing(50.0, 50.0), count), torch.linspace(-0.3, 0.3, 10)
    posture = Posture(pose, betas, None)
    cameras = [
        framing(Primitives.place(frames, PAYLOAD), math.degrees(0.2) * i, size, size)
        for i, frames in enumerate(posture.frames())
    ]
    return dataclasses.replace(posture, camera=stack(cameras))


def joints_px(posture: Posture) -> torch.Tensor:
    pairs = zip(each(posture.pose), each(posture.camera), strict=True)
    return torch.stack([camera.project(pose_body(posture.betas, pose).joints[:, :3, 3])[0] for pose, camera in pairs])


def disturbed(posture: Posture, degrees: float = 8.0) -> Posture:
    turn = torch.randn(len(posture.pose.translation), 24, 3, generator=torch.Generator().manual_seed(3))
    rotation = posture.pose.joint_rotation @ axis_angle_to_matrix(math.radians(degrees) / math.sqrt(3) * turn)
    pose = BodyPose(rotation, posture.pose.translation + torch.tensor([0.06, -0.04, 0.1]))
    return dataclasses.replace(posture, pose=pose, betas=torch.zeros(10))


def test_a_disturbed_posture_before_two_cameras_is_found_again():
    true = a_posture(2)
    start = disturbed(true)
    fit = PostureFit(start, STANDARD_SHAPES)
    assert (joints_px(fit.posture()) - joints_px(start)).abs().max() < 1e-3
    steps = []
    fit.refine(PAYLOAD, [*seen(true)], Stage(60, 0.03), lambda: steps.append(1))
    found = fit.posture()
    before, after = ((joints_px(posture) - joints_px(true)).norm(dim=-1).mean() for posture in (start, found))
    assert before > 1.5
    assert after < 0.35 * before
    assert len(steps) == 60
    parts = zip(seen(true), found.frames(), each(found.camera), strict=True)
    assert max(outline_error(PAYLOAD, dataclasses.replace(t, frames=f, camera=c)) for t, f, c in parts) < 0.01


def test_a_body_seen_by_a_tilted_camera_is_found_upright():
    start, degrees = a_posture(), 12.0
    tilted = tilted_about_body(start, degrees)
    fit = PostureFit(start, STANDARD_SHAPES)
    fit.refine(PAYLOAD, seen(tilted), Stage(60, 0.03))
    found = fit.posture()
    up = found.camera.world_to_camera[0, :, 1]
    assert 0.5 < -math.degrees(math.asin(up[2])) / degrees < 1.2  # the picture shows it weakly, and 0 is usual
    places = pose_body(found.betas, next(each(found.pose))).joints[:, :3, 3]
    torso = torch.nn.functional.normalize(places[JOINT_NAMES.index("neck")] - places[0], dim=0)
    assert math.degrees(math.acos(torso[1])) < 2.5


def tilted_about_body(posture: Posture, degrees: float) -> Posture:
    """By cameras that are turned, and moved so that the pelvis is where it was in the picture."""
    turn = axis_angle_to_matrix(torch.tensor([math.radians(degrees), 0.0, 0.0]))
    rotation, translation = turn @ posture.camera.world_to_camera[:, :, :3], posture.camera.world_to_camera[:, :, 3]
    pelvis = pose_body(posture.betas, next(each(posture.pose))).joints[0, :3, 3]
    before = posture.camera.world_to_camera[:, :, :3] @ pelvis + translation
    extrinsics = torch.cat([rotation, (before - rotation @ pelvis)[:, :, None]], -1)
    return dataclasses.replace(posture, camera=dataclasses.replace(posture.camera, world_to_camera=extrinsics))


def test_a_camera_is_usual_at_the_height_of_hands():
    body, pose = default_body().shape(torch.zeros(10)), standing(50.0, 50.0)
    floor = float(body.pose(pose).vertices[0, :, 1].min())
    heights = [float(deviations(body, pose, torch.tensor([floor + height]))[-1]) for height in (1.5, 2.4)]
    assert heights == pytest.approx([0, 3], abs=1e-3)


@pytest.mark.parametrize(
    ("joint", "degrees", "kinds"),
    [
        ("neck", 20, []),
        ("pelvis", 20, [0, 1, 3, 4]),
        ("spine1", 20, [0]),
        ("left_hip", -20, [1, 2, 3]),
        ("right_ankle", 20, [2, 4]),
    ],
)
def test_a_body_that_leans_or_lifts_a_foot_is_unusual(joint, degrees, kinds):
    theta = torch.zeros(1, 24, 3)
    theta[0, JOINT_NAMES.index(joint), 0] = math.radians(degrees)
    body, camera = default_body().shape(torch.zeros(10)), torch.tensor([0.5])
    off = deviations(body, BodyPose.from_axis_angle(theta.flatten(1)), camera)[:-1, 0]
    assert (off.abs() > 2).nonzero()[:, 0].tolist() == kinds


def test_who_strides_may_lean_forward():
    body, height, lean = default_body().shape(torch.zeros(10)), torch.tensor([1.5]), math.radians(6)
    found = []
    for stride in (0, 25):
        upright = standing(50.0, 50.0, stride=stride)
        forward = axis_angle_to_matrix(torch.tensor([lean, 0.0, 0.0]))
        rotation = torch.cat([upright.joint_rotation[:, :1] @ forward, upright.joint_rotation[:, 1:]], 1)
        found.append(float(deviations(body, BodyPose(rotation, upright.translation), height)[0]))
    assert found == pytest.approx([3.1, 0.35], abs=0.1)


def test_a_guessed_lens_moves_and_a_stated_one_hardly():
    start = a_posture()
    camera, pelvis = start.camera, pose_body(start.betas, next(each(start.pose))).joints[0, :3, 3]
    away, near = camera.world_to_camera.clone(), 0.6
    before = away[0, :, :3] @ pelvis + away[0, :, 3]
    away[0, :, 3] += (near - 1) * before  # as large, by a wider lens
    wide = torch.cat([camera.intrinsics[:, :, :2] * near, camera.intrinsics[:, :, 2:]], -1)
    true = dataclasses.replace(start, camera=dataclasses.replace(camera, intrinsics=wide, world_to_camera=away))
    found = []
    for stated in (False, True):
        fit = PostureFit(start, STANDARD_SHAPES, tilted=False, stated=[stated])
        fit.refine(PAYLOAD, seen(true), Stage(40, 0.02))
        found.append(float(fit.posture().camera.intrinsics[0, 0, 0] / camera.intrinsics[0, 0, 0]))
    print(found)
    assert found[0] < 0.8
    assert found[1] > 0.9


def test_a_lean_to_the_side_is_more_unusual_than_one_forward_however_the_body_is_turned():
    body, height, found = default_body().shape(torch.zeros(10)), torch.tensor([1.5]), {}
    for turned in (0, 70):
        upright = standing(50.0, 50.0, turned=turned)
        for axis in (0, 2):
            lean = axis_angle_to_matrix(torch.eye(3)[axis] * math.radians(6))
            rotation = torch.cat([upright.joint_rotation[:, :1] @ lean, upright.joint_rotation[:, 1:]], 1)
            found[turned, axis] = float(deviations(body, BodyPose(rotation, upright.translation), height)[0])
    assert found[0, 0] == pytest.approx(3, abs=0.15)
    assert found[0, 2] == pytest.approx(4, abs=0.15)
    assert found[70, 0] == pytest.approx(found[0, 0], abs=1e-3)
    assert found[70, 2] == pytest.approx(found[0, 2], abs=1e-3)


def test_a_bow_that_a_pose_file_states_stays():
    bow = a_posture()
    theta = torch.zeros(1, 24, 3)
    theta[0, JOINT_NAMES.index("spine1"), 0] = math.radians(45)
    bow = dataclasses.replace(bow, pose=BodyPose.from_axis_angle(theta.flatten(1)))
    fit = PostureFit(bow, STANDARD_SHAPES, 2.0)
    fit.refine(PAYLOAD, seen(bow), Stage(40, 0.02))
    found, true = (pose_body(one.betas, next(each(one.pose))).joints[:, :3, 3] for one in (fit.posture(), bow))
    turned = [places[JOINT_NAMES.index("neck")] - places[0] for places in (found, true)]
    assert torch.cosine_similarity(*turned, dim=0) > math.cos(math.radians(6))


def test_what_pictures_do_not_show_stays_where_it_was():
    true = a_posture()
    fit = PostureFit(true, STANDARD_SHAPES)
    fit.refine(PAYLOAD, seen(true), Stage(40, 0.02))
    assert (fit.posture().pose.joint_rotation - true.pose.joint_rotation).abs().max() < 0.15
    assert (joints_px(fit.posture()) - joints_px(true)).norm(dim=-1).max() < 1.0


def test_shapes_stay_within_those_of_people():
    true = a_posture()
    tall = [dataclasses.replace(target, rgba=torch.ones_like(target.rgba)) for target in seen(true)]
    fit = PostureFit(true, STANDARD_SHAPES)
    fit.refine(PAYLOAD, tall, Stage(60, 0.1))
    assert fit.posture().betas.abs().max() <= STANDARD_SHAPES.limit.max()


def test_an_exception_cancels():
    true = a_posture()

    def cancel() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        PostureFit(true, STANDARD_SHAPES).refine(PAYLOAD, seen(true), Stage(10, 0.02), cancel)


def photographed(posture: Posture, window: Window, width: int, height: int) -> Photograph:
    (target,) = seen(posture)
    return Photograph(Path("a.png"), (255 * target.rgba).round().byte().numpy(), window, width, height, None)


def test_a_framed_body_covers_the_mask_and_cameras_of_windows_are_those_of_pictures():
    true = a_posture()
    photograph = photographed(true, Window(300.5, -20, 640, 640), 1200, 600)
    camera = framed([photograph], true.pose, true.betas, [photograph.lens()])
    posture = dataclasses.replace(true, camera=camera)
    assert outline_error(PAYLOAD, dataclasses.replace(seen(true)[0], camera=next(each(camera)))) < 0.04
    (view,) = views_of([photograph], camera)
    assert (view.width, view.height) == (1200, 600)
    assert view.intrinsics[:2, 2] == pytest.approx([600, 300], abs=1e-2)
    again = cameras_of([photograph], [view])
    assert torch.allclose(again.intrinsics, camera.intrinsics, rtol=1e-5)
    assert joints_px(posture)[0, 0, 0] == pytest.approx(float(joints_px(true)[0, 0, 0]), abs=2)


def test_a_posture_before_another_camera_looks_the_same():
    posture = a_posture()
    turned = framing(Primitives.place(posture.frames()[0], PAYLOAD), 109, 64, 64)
    other = dataclasses.replace(posture.camera, world_to_camera=turned.world_to_camera[None])
    moved = place_in_camera(posture, other)
    assert torch.allclose(joints_px(moved), joints_px(posture), atol=1e-2)


def test_poses_in_a_cameras_axes_are_turned_upright():
    pose = standing(30.0, 30.0)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    rotation = torch.cat([(flip @ pose.joint_rotation[:, :1]), pose.joint_rotation[:, 1:]], 1)
    turned = turned_to_camera(BodyPose(rotation, torch.ones(1, 3)))
    assert torch.allclose(turned.joint_rotation, pose.joint_rotation, atol=1e-6)
    assert turned_to_camera(pose) is pose


def test_one_pose_serves_all_pictures_and_others_must_be_as_many():
    assert repeated(standing(0.0, 0.0), 3).joint_rotation.shape == (3, 24, 3, 3)
    with refused(ValueError, "2 poses", "3 pictures"):
        repeated(repeated(standing(0.0, 0.0), 2), 3)


def test_a_posture_is_read_as_it_was_written(tmp_path):
    posture = a_posture(2)
    photographs = [photographed(a_posture(), Window(10, 20, 128, 128), 300, 200)] * 2
    views = views_of(photographs, posture.camera)
    path = tmp_path / "posture.json"
    write_posture(path, posture.pose, posture.betas, views)
    found = read_posture(path, [(300, 200)] * 2)
    assert torch.allclose(found.pose.joint_rotation, posture.pose.joint_rotation, atol=1e-5)
    assert torch.allclose(found.betas, posture.betas, atol=1e-5)
    for read in (found.views, read_cameras(path, [(300, 200)] * 2)):
        assert all(np.allclose(a.intrinsics, b.intrinsics) for a, b in zip(read, views, strict=True))
    with refused(FileError, str(path), "2 cameras", "1 pictures"):
        read_posture(path, [(300, 200)])


def test_pose_files_of_others_give_a_pose_alone(tmp_path):
    path = tmp_path / "pose.npz"
    np.savez(path, poses=np.zeros((1, 156)), betas=np.ones(16))
    found = read_posture(path, [(10, 10)])
    assert (found.betas, found.views) == (None, None)
    assert found.pose.joint_rotation.shape == (1, 24, 3, 3)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"betas": [9.0] * 10}, "betas"), ({"betas": [0.0]}, "betas"), ({"betas": "x"}, "betas"),
     ({"pose": [[0.0] * 60]}, "pose"), ({"cameras": {}}, "cameras"), ({"cameras": {"camera0000": {}}}, "camera0000"),
     ({"cameras": {"camera0000": {"K": np.eye(3).tolist(), "R": (-np.eye(3)).tolist(), "T": [0] * 3}}}, "camera0000")],
)  # fmt: skip
def test_damaged_postures_are_refused(tmp_path, change, word):
    path, posture = tmp_path / "posture.json", a_posture()
    write_posture(
        path,
        posture.pose,
        posture.betas,
        views_of([photographed(posture, Window(0, 0, 64, 64), 64, 64)], posture.camera),
    )
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with refused(ValueError, str(path), word):
        read_posture(path, [(64, 64)])


def reddish_in_front_and_bluish_behind() -> DiffusionModel:
    prior = MODEL.denoiser.prior
    ahead = place(Human(PAYLOAD, torch.zeros(10), {})).rotation[:, 2, 2].reshape(prior.mean.shape[1:])
    mean = torch.stack([4 * ahead, 0 * ahead, -4 * ahead, 0 * ahead])
    denoiser = PersonDenoiser(MODEL.denoiser.config, dataclasses.replace(prior, mean=mean), MODEL.schedule)
    return dataclasses.replace(MODEL, denoiser=denoiser)


def test_a_person_is_found_from_any_side_in_each_picture(monkeypatch):
    """The last one's outline is that of a front, and its colours those of a back, which decide."""
    model, stage, photographs = reddish_in_front_and_bluish_behind(), Stage(8, 0.03, upright=False), []
    turns, drawn = (8, 98, 262, 188), (8, 98, 262, 8)
    monkeypatch.setattr(from_pictures, "FIT_STAGES", [from_pictures.FitStage(48, stage, steps) for steps in (0, 1, 0)])
    for turned, true in zip(drawn, turns, strict=True):
        payload = model.decode((1 if turned == true else -1) * model.denoiser.prior.mean)
        pose, betas = standing(60.0, 60.0, turned=turned), torch.zeros(10)
        (frames,) = Posture(pose, betas, None).frames()
        camera = framing(Primitives.place(frames, payload), 0.0, 96, 96)
        with torch.no_grad():
            picture = march(Primitives.place(frames, payload), camera)
        rgba = torch.cat([encode_srgb(picture.rgb.clamp(0, 1)), picture.alpha[..., None]], -1)
        pixels = (255 * rgba).round().byte().numpy()
        photographs.append(Photograph(Path("a.png"), pixels, Window(0, 0, 96, 96), 96, 96, None))
    start = from_pictures.initial_pose(photographs, model)
    assert set(start.pictures) == set(range(4))
    monkeypatch.setattr(from_pictures, "outline_error", lambda *_: 1.0)
    found = from_pictures.fit_posture_in(model, photographs, start, lambda: None).posture
    for rotation, turned in zip(found.pose.joint_rotation[:, 0], turns, strict=True):
        off = math.degrees(math.atan2(rotation[0, 2], rotation[2, 2])) - turned
        assert abs((off + 180) % 360 - 180) < 15


def test_an_arm_beside_the_true_one_is_better_than_none_after_a_blur():
    true, near, none = (
        Posture(standing(50.0, right_arm), torch.zeros(10), None).frames()[0] for right_arm in (-40.0, -55.0, 60.0)
    )
    camera = framing(Primitives.place(true, PAYLOAD), 0.0, 96, 96)
    with torch.no_grad():
        seen = march(Primitives.place(true, PAYLOAD), camera)
    rgba, share = torch.cat([seen.rgb, seen.alpha[..., None]], -1), {}
    for blur in (0.0, 0.03):
        errors = [outline_error(PAYLOAD, PosedView(frames, camera, rgba), blur) for frames in (true, near, none)]
        assert errors[0] < 1e-4
        share[blur] = errors[1] / errors[2]
    assert share[0.03] < 0.6 * share[0.0]


def test_each_arm_may_be_raised_in_a_picture_from_the_side():
    """The outline is the same, and colours decide."""
    rgba = np.zeros((96, 96, 4), np.uint8)
    posture = Posture(standing(60.0, -45.0, 10.0, turned=100.0), torch.zeros(10), None)
    (frames,) = posture.frames()
    with torch.no_grad():
        picture = march(Primitives.place(frames, PAYLOAD), framing(Primitives.place(frames, PAYLOAD), 0.0, 96, 96))
    rgba[..., 3] = (255 * picture.alpha).byte()
    photograph = Photograph(Path("a.png"), rgba, Window(0, 0, 96, 96), 96, 96, None)
    start = from_pictures.initial_pose([photograph, photograph], MODEL)
    joints = [pose_body(start.posture.betas, pose).joints[:, 1, 3] for pose in each(start.posture.pose)]
    left, right = (torch.stack(joints)[:, JOINT_NAMES.index(f"{side}_wrist")] for side in ("left", "right"))
    assert (left > right + 0.5).any()
    assert (right > left + 0.5).any()


@pytest.mark.parametrize("shown", [1.0, 0.96, 0.7])
def test_of_a_person_who_is_cut_off_the_rows_below_are_not_shown(shown):
    posture, rgba = a_posture(), np.full((64, 64, 4), 90, np.uint8)
    rgba[..., 3] = (255 * seen(posture)[0].rgba[..., 3]).byte()
    top, bottom = np.flatnonzero((rgba[..., 3] > 127).any(1))[[0, -1]]
    last = round(top + shown * (bottom - top))
    rgba[last + 1 :, :, 3] = 0
    photograph = Photograph(Path("a.png"), rgba, Window(0, 0, 64, 64), 64, 64, None)
    person = from_pictures.person_in([photograph], posture, ["before"])
    height = person.views.camera.height
    assert person.views.rgba.shape[1] == height == (last + 1 if shown < 0.9 else 64)
    assert np.array_equal(person.views.rgba[0], rgba[:height])
    assert ["no feet" in warning for warning in person.warnings] == [False, True][: 1 + (shown < 0.9)]
    both = from_pictures.person_in([photograph] * 2, a_posture(2))
    assert both.views.rgba.shape[1] == 64


def test_hands_of_bent_arms_are_at_the_hips():
    body = default_body().shape(torch.zeros(10)).pose(standing(55.0, 55.0, 0.0, 96.0))
    for side in ("left", "right"):
        hand, hip = (body.joints[0, JOINT_NAMES.index(f"{side}_{name}"), :3, 3] for name in ("wrist", "hip"))
        assert (hand - hip).norm() < 0.3


def test_arms_of_a_standing_body_are_lowered():
    body = default_body().shape(torch.zeros(10)).pose(standing(60.0, 60.0))
    joints = body.joints[0, :, 1, 3]
    shoulder, wrist = (joints[JOINT_NAMES.index(name)] for name in ("left_shoulder", "left_wrist"))
    assert wrist < shoulder - 0.3
