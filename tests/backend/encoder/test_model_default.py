"""The encoder that comes with the package."""

import pytest
import torch
from capture_scenes import save_person
from fit_scenes import patched_person
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.conditioning import conditioning_views, default_betas
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.encoder.config import PRESETS
from primdiffusion.encoder.model import default_encoder, load_encoder
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.render.march import march


@pytest.fixture(scope="module")
def encoder():
    return load_encoder()


def test_its_file_is_small_enough_to_ship():
    assert default_encoder().stat().st_size <= 24e6


def test_it_is_the_default_preset_and_its_card_says_how_it_was_trained(encoder):
    assert encoder.config == PRESETS["default"]
    assert {"people", "steps", "batch", "seconds", "device", "seed", "licence", "full_density"} <= encoder.card.keys()
    assert encoder.card["full_density"] == encoder.config.full_density


def test_an_unseen_human_is_rendered_from_a_new_side_in_a_new_pose(encoder, tmp_path):
    people = {"person_000000": save_person(tmp_path / "person.glb", patched_person())}
    poses = built_in_poses().map(lambda values: values[:2])
    assert isinstance(poses, BodyPose)
    job = RenderJob(people, poses, tmp_path / "captures", Rig("sphere", 9, width=192, height=192), ("img", "mask"))
    assert [outcome.status for outcome in render(job)] == ["done"]
    captures = open_captures(job.out)
    betas = default_betas(captures.subject("person_000000"))
    payload = encoder.encode(conditioning_views(captures, "person_000000", 0, range(8)), betas)
    target = conditioning_views(captures, "person_000000", 1, [8])
    drawn = march(encoder.place(payload, betas, target.pose), target.camera)
    error = (encode_srgb(drawn.rgb[0]) - target.image[0] / 255).square().mean()
    assert -10 * torch.log10(error) > 28
    covered, mask = drawn.alpha[0] > 0.5, target.mask[0] > 127
    assert (covered & mask).sum() / (covered | mask).sum() > 0.9
