"""Fits say how good they are: pictures of the tiny model's human, whole and spoiled."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from primdiffusion.capture.photograph import Photograph
from primdiffusion.capture.reader import Window
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.human import framing
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.reconstruction.from_pictures import Found, fit_quality
from primdiffusion.reconstruction.posture_fit import Posture
from primdiffusion.reconstruction.posture_masks import without_things
from primdiffusion.reconstruction.posture_quality import (
    HEAD_SHARE,
    LARGEST_DIFFERENCE,
    LEAST_PERCENT,
    LIMITS,
    FitQuality,
    colour_error,
)
from primdiffusion.reconstruction.posture_start import standing
from primdiffusion.reconstruction.prior_fit import PriorFit
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import march
from support.tiny import tiny_model

MODEL, SIDE = tiny_model(), 96
COMPONENTS = PriorFit.of(MODEL)
PAYLOAD = COMPONENTS.payload(COMPONENTS.coefficients(COMPONENTS.everyone()))
NONE = FitQuality(**dict.fromkeys(LIMITS, 0.0), limb="left forearm")


def a_posture() -> Posture:
    pose, betas = standing(50.0, 50.0), torch.zeros(10)
    (frames,) = Posture(pose, betas, None).frames()
    camera = framing(Primitives.place(frames, PAYLOAD), 0.0, SIDE, SIDE)
    return Posture(pose, betas, camera.map(lambda values: values[None]))


POSTURE = a_posture()


def seen(posture: Posture = POSTURE) -> tuple[Photograph, PosedView]:
    """The human's picture, 8-bit and linear."""
    (frames,), camera = posture.frames(), posture.camera.map(lambda values: values[0])
    with torch.no_grad():
        picture = march(Primitives.place(frames, PAYLOAD), camera)
    rgba = torch.cat([encode_srgb(picture.rgb.clamp(0, 1)), picture.alpha[..., None]], -1)
    pixels = (255 * rgba).round().to(torch.uint8).numpy()
    photograph = Photograph(Path("anna.png"), pixels, Window(0, 0, SIDE, SIDE), SIDE, SIDE, None)
    return photograph, PosedView(frames, camera, torch.cat([picture.rgb, picture.alpha[..., None]], -1))


def with_ball() -> tuple[Photograph, np.ndarray]:
    """The picture with a ball at one side of the legs, and where the ball is."""
    photograph, _ = seen()
    rows, columns = np.mgrid[:SIDE, :SIDE]
    ball = (rows - 0.8 * SIDE) ** 2 + (columns - 0.8 * SIDE) ** 2 < (0.1 * SIDE) ** 2
    rgba = photograph.rgba.copy()
    rgba[ball] = (200, 30, 30, 255)
    return dataclasses.replace(photograph, rgba=rgba), ball


def quality(photograph: Photograph, posture: Posture = POSTURE, kept: Photograph | None = None) -> FitQuality:
    return fit_quality(MODEL, [photograph], Found(posture, [photograph if kept is None else kept]))


def test_a_whole_human_in_its_own_posture_fits_and_says_nothing():
    found = quality(seen()[0])
    assert found.percent > LEAST_PERCENT
    assert found.warnings() == []
    assert found.content()["percent"] == found.percent
    assert set(found.content()) == {"percent", "worst", *LIMITS}


def test_a_head_counts_more_than_a_limb_that_is_elsewhere():
    """The head's rows, and as many at the hips, get other colours; at the hips by far."""
    _, target = seen()
    rows = (target.rgba[..., 3] > 0.9).any(1).nonzero()[:, 0]
    errors = {}
    for first, change in ((0, 0.0), (0, 0.3), (len(rows) // 2, 0.3), (len(rows) // 2, 0.9)):
        rgba = target.rgba.clone()
        rgba[rows[first] : rows[first + len(rows) // 8], :, :3] += change
        errors[first, change] = colour_error(PAYLOAD, dataclasses.replace(target, rgba=rgba))
    same, head, hips, far = errors.values()
    assert same < 0.01
    assert hips - same == pytest.approx(far - same, rel=0.1)
    assert hips - same < LARGEST_DIFFERENCE / 2
    assert head > hips + HEAD_SHARE * LARGEST_DIFFERENCE
    assert colour_error(PAYLOAD, dataclasses.replace(target, rgba=0 * target.rgba)) == 1.0


def test_a_ball_is_left_out_whole_and_the_human_is_kept():
    photograph, ball = with_ball()
    _, target = seen()
    rgba = torch.from_numpy(photograph.rgba.astype(np.float32) / 255)
    kept = without_things(PAYLOAD, photograph, dataclasses.replace(target, rgba=rgba))
    body = target.rgba[..., 3].numpy() > 0.5
    assert not kept.rgba[ball & ~body].any()
    assert np.array_equal(kept.rgba[body], photograph.rgba[body])
    found = quality(photograph, kept=kept)
    assert found.left_out == pytest.approx((ball & ~body).sum() / (ball | body).sum(), abs=0.02)
    assert "belongs to no body" in found.warnings()[0]


def test_parts_are_left_out_of_the_large_picture_where_they_are_in_the_small_one():
    photograph, _ = with_ball()
    _, target = seen()
    rgba = torch.from_numpy(photograph.rgba.astype(np.float32) / 255)
    large = np.pad(photograph.rgba.repeat(6, 0).repeat(6, 1), [(0, 2), (0, 2), (0, 0)])  # 96 x 6 + 2 pixels
    kept = without_things(PAYLOAD, dataclasses.replace(photograph, rgba=large), dataclasses.replace(target, rgba=rgba))
    same = without_things(PAYLOAD, photograph, dataclasses.replace(target, rgba=rgba))
    assert np.array_equal(kept.rgba[: 6 * SIDE : 6, : 6 * SIDE : 6], same.rgba)


def test_what_is_explained_is_left_as_it_is():
    photograph, target = seen()
    assert without_things(PAYLOAD, photograph, target) is photograph


def test_a_ball_that_is_still_there_is_a_failed_fit():
    found = quality(with_ball()[0])
    assert found.percent < LEAST_PERCENT
    assert "pose a human over the picture by hand, or mask" in found.warnings()[-1]


def test_a_leg_that_the_mask_lacks_is_a_failed_fit_that_names_it():
    photograph, _ = seen()
    rgba = photograph.rgba.copy()
    rgba[int(0.7 * SIDE) :, SIDE // 2 :] = 0  # the person's left, seen from the front
    found = quality(dataclasses.replace(photograph, rgba=rgba))
    assert found.percent < LEAST_PERCENT
    assert found.outside > 0.9
    assert found.limb == "left lower leg"


def test_a_foot_that_the_mask_lacks_is_a_failed_fit():
    photograph, target = seen()
    rgba, rows = photograph.rgba.copy(), np.flatnonzero(target.rgba[..., 3].any(1).numpy())
    rgba[rows[-1] - 4 :, : SIDE // 2] = 0
    found = quality(dataclasses.replace(photograph, rgba=rgba))
    assert found.worst == "foot"
    assert "a foot lies outside of the mask" in found.warnings()[0]


def with_joint(joint: str, degrees: tuple[float, float, float], posture: Posture = POSTURE) -> Posture:
    rotation = posture.pose.joint_rotation.clone()
    rotation[0, JOINT_NAMES.index(joint)] = axis_angle_to_matrix(torch.tensor(degrees) * math.pi / 180)
    return dataclasses.replace(posture, pose=dataclasses.replace(posture.pose, joint_rotation=rotation))


def test_a_hand_behind_the_trunk_is_a_failed_fit_from_the_front_alone():
    behind = with_joint("left_shoulder", (0.0, 100.0, 0.0))
    found = quality(seen(behind)[0], behind)
    assert found.hidden > LIMITS["hidden"]
    assert "a hand is not where the body has it: it is hidden" in found.warnings()[-1]
    turned = with_joint("pelvis", (0.0, 90.0, 0.0), behind)
    from_side = quality(seen(turned)[0], turned)
    assert (from_side.hands, from_side.hidden, from_side.skin) == (0, 0, 0)


def test_a_hand_of_another_colour_than_the_other_is_a_failed_fit():
    photograph, target = seen()
    rgba, columns = photograph.rgba.copy(), np.flatnonzero(target.rgba[..., 3].any(0).numpy())
    left = rgba[:, columns[-1] - 8 :]  # seen from the front
    left[..., :3] = left[..., :3] * 0.7
    assert quality(dataclasses.replace(photograph, rgba=rgba)).hands < LIMITS["hands"] / 2  # darker
    left[..., :3] = left[..., 3:] * np.array([0.2, 0.5, 0.8])
    found = quality(dataclasses.replace(photograph, rgba=rgba))
    assert found.hands > 2 * LIMITS["hands"]
    assert "a hand is not where the body has it" in found.warnings()[-1]


def test_a_head_without_the_colour_of_hands_is_that_of_no_one_who_faces_the_camera():
    photograph, target = seen()
    rgba, rows = photograph.rgba.copy(), np.flatnonzero(target.rgba[..., 3].any(1).numpy())
    rgba[rows[0] : rows[0] + len(rows) // 6, :, :3] //= 8
    assert quality(photograph).skin < LIMITS["skin"]
    found = quality(dataclasses.replace(photograph, rgba=rgba))
    assert found.skin > LIMITS["skin"]
    assert "the head is not that of a person seen from the front" in found.warnings()[-1]


def test_a_head_of_other_colours_is_a_failed_fit():
    photograph, target = seen()
    rgba, rows = photograph.rgba.copy(), np.flatnonzero(target.rgba[..., 3].any(1).numpy())
    head = slice(rows[0], rows[0] + len(rows) // 8)
    rgba[head, :, :3] = rgba[head, :, 3:]
    found = quality(dataclasses.replace(photograph, rgba=rgba))
    assert found.head > LIMITS["head"]
    assert found.head > 3 * quality(photograph).head


@pytest.mark.parametrize(
    ("joint", "turn"), [("left_knee", (0, 0, 40)), ("right_knee", (-40, 0, 0)), ("left_elbow", (0, 90, 0))]
)
def test_joints_that_bend_as_they_cannot_are_a_failed_fit(joint, turn):
    bent = with_joint(joint, turn)
    found = quality(seen(bent)[0], bent)
    assert found.joint > 1
    assert found.percent < LEAST_PERCENT


@pytest.mark.parametrize("name", LIMITS)
def test_each_value_at_its_limit_is_the_least_good_fit(name):
    at, above = (NONE._replace(**{name: factor * LIMITS[name]}) for factor in (1 - 1e-6, 1.01))
    assert at.percent == LEAST_PERCENT
    assert above.percent < LEAST_PERCENT
    assert above.worst == name
    assert len(above.warnings()) == 1 + (name == "left_out")
    assert NONE._replace(**{name: 1e3}).percent == 0
