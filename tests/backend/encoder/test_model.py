"""From pictures of a person to their payload."""

import dataclasses
import itertools
import json

import pytest
import torch
from capture_scenes import save_person
from fit_scenes import patched_person
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.conditioning import conditioning_views, default_betas
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import Views, open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.encoder.config import PRESETS, config_from_json, encoder_config
from primdiffusion.encoder.model import (
    EncoderModel,
    default_encoder,
    encode,
    frames_of,
    load_encoder,
    save_encoder,
    unproject_views,
)
from primdiffusion.encoder.network import Encoder
from primdiffusion.encoder.unproject import unproject_voxels
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.geometry.camera import look_at
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.primitives.primitives import Frames, K, S
from primdiffusion.render.march import march
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from support.errors import refused
from support.tiny import TINY, save_tiny_encoder, tiny_encoder


def blank_views(count: int = 2, pixels: int = 24) -> Views:
    yaws = (torch.tensor([0.0, 0, 3]), torch.tensor([3.0, 0, 0.1]))
    cameras = [
        look_at(at, torch.zeros(3), vertical_fov=0.8, width=pixels, height=pixels)
        for at in itertools.islice(itertools.cycle(yaws), count)
    ]
    return Views(torch.full((count, pixels, pixels, 4), 200, dtype=torch.uint8), stack(cameras), BodyPose.rest())


@pytest.mark.parametrize("count", [1, 2])
def test_a_person_comes_out_of_one_view_or_more(count):
    model = tiny_encoder()
    payload = model.encode(blank_views(count), torch.zeros(10)).validate()
    assert payload.rgb.shape == (K, 3, S, S, S)
    assert not payload.rgb.requires_grad
    assert model.place(payload, torch.zeros(10), BodyPose.rest()).position.shape == (K, 3)


def test_pictures_without_the_person_still_give_finite_values():
    views = blank_views()
    views = dataclasses.replace(views, rgba=torch.zeros_like(views.rgba))
    tiny_encoder().encode(views, torch.zeros(10)).validate()


@pytest.mark.parametrize("betas", [torch.zeros(9), torch.zeros(2, 10), torch.full((10,), torch.nan)])
def test_betas_of_another_body_are_rejected(betas):
    with refused(ValueError, "10 finite"):
        unproject_views(TINY, blank_views(), betas.reshape(-1) if betas.ndim > 1 else betas)


def test_poses_that_are_not_finite_are_rejected():
    views = blank_views()
    broken = dataclasses.replace(views, pose=views.pose.map(lambda tensor: tensor * torch.nan))
    with refused(ValueError, "NaN"):
        encode(Encoder(TINY), broken, torch.zeros(10))


def test_voxels_are_looked_up_where_the_marcher_will_draw_them():
    encoder, betas, views = tiny_encoder().encoder, torch.zeros(10), blank_views(2, 96)
    ramp = torch.arange(96, dtype=torch.uint8)
    rgba = views.rgba.clone()
    rgba[..., 0], rgba[..., 1] = ramp, ramp[:, None]
    views = dataclasses.replace(views, rgba=rgba)
    payload = tiny_encoder().encode(views, betas)
    vertices, _ = frames_of(encoder.config, betas, views.pose)
    drawn = tiny_encoder().place(payload, betas, views.pose)
    found = unproject_views(encoder.config, views, betas)
    assert (payload.delta_scale / found.extent - 1).abs().max() < 0.1  # nothing is learned yet
    rest = Frames(drawn.position, drawn.rotation, drawn.half_extent / payload.delta_scale)
    there = unproject_voxels(views, vertices, rest, found.extent, encoder.config.facing)
    for name in ("rgb", "seen", "covered"):  # but for what a rounded bit puts on the other side of an edge
        assert (getattr(found, name) != getattr(there, name)).float().mean() < 1e-3, name


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


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return save_tiny_encoder(tmp_path_factory.mktemp("encoder") / "encoder.safetensors")


def changed(saved, path, tensors=None, **metadata):
    """The same file with other tensors or metadata; None takes an entry away."""
    with safe_open(saved, framework="pt") as file:
        before = file.metadata()
    after = {key: value for key, value in {**before, **metadata}.items() if value is not None}
    save_file(load_file(saved) if tensors is None else tensors, path, metadata=after)
    return path


def test_an_encoder_comes_back_with_its_settings_card_and_weights_to_half_precision(saved):
    back, before = load_encoder(saved), tiny_encoder()
    assert back.config == TINY
    assert back.card == {"name": "tiny encoder"}
    assert not back.encoder.training
    for (name, value), expected in zip(
        back.encoder.state_dict().items(), before.encoder.state_dict().values(), strict=True
    ):
        assert value.dtype == torch.float32, name
        assert torch.equal(value, expected.half().float())
        assert not value.requires_grad


def test_a_missing_file_is_named(tmp_path):
    with refused(FileNotFoundError, "nothing.safetensors"):
        load_encoder(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize(
    "metadata",
    [
        {"format": "pt"},
        {"format_version": "9"},
        {"config": json.dumps({"stem": [2, 2, 4]})},
        {"config": "{"},
        {"config": None},
        {"card": "["},
        {"config": json.dumps(dataclasses.asdict(dataclasses.replace(TINY, fused=8)))},
        {"config": json.dumps(dataclasses.asdict(TINY) | {"stem": 3})},
        {"config": json.dumps(dataclasses.asdict(TINY) | {"attention_blocks": 10**9})},
        {"config": json.dumps(dataclasses.asdict(TINY) | {"fused": 10**6})},
    ],
)
def test_a_file_that_is_something_else_is_rejected_in_one_line(saved, tmp_path, metadata):
    with refused(FileError, str(tmp_path / "other")) as error:
        load_encoder(changed(saved, tmp_path / "other", **metadata))
    assert "\n" not in str(error.value)


def test_weights_that_are_missing_or_not_finite_are_rejected(saved, tmp_path):
    tensors = load_file(saved)
    key = next(iter(tensors))
    with refused(FileError):
        load_encoder(changed(saved, tmp_path / "less", {k: v for k, v in tensors.items() if k != key}))
    with refused(FileError, "NaN"):
        load_encoder(changed(saved, tmp_path / "nan", {**tensors, key: torch.full_like(tensors[key], float("nan"))}))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e6])
def test_weights_that_half_precision_cannot_hold_replace_no_file(saved, tmp_path, bad):
    path = tmp_path / "encoder.safetensors"
    path.write_bytes(saved.read_bytes())
    encoder = Encoder(TINY)
    with torch.no_grad():
        encoder.scale_out.bias[0, 0, 0] = bad
    with refused(FileError, "scale_out.bias"):
        save_encoder(path, EncoderModel(encoder, {}))
    assert path.read_bytes() == saved.read_bytes()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_unknown_and_missing_settings_are_rejected_by_name():
    tree = dataclasses.asdict(TINY)
    with refused(ValueError, "colour_of_eyes"):
        config_from_json({**tree, "colour_of_eyes": "blue"})
    with refused(ValueError, "differs"):
        config_from_json({name: value for name, value in tree.items() if name != "motion"})


@pytest.mark.parametrize(
    "settings",
    [
        {"appearance": "pixels"},
        {"attention": "some"},
        {"grid": ()},
        {"grid": (8,) * 7},
        {"attention_width": 6, "attention_heads": 4},
        {"attention_blocks": 17},
        {"scale_outputs": 2},
    ],
)
def test_impossible_settings_are_rejected(settings):
    ((name, value), *_) = settings.items()
    with refused(ValueError, name, str(list(value) if isinstance(value, tuple) else value)):
        dataclasses.replace(TINY, **settings)
    with refused(ValueError, next(iter(settings))):
        config_from_json({**dataclasses.asdict(TINY), **settings})


def test_each_ablation_differs_from_the_default_in_one_thing():
    default = dataclasses.asdict(PRESETS["default"])
    one_size = {"delta_scale", "thickness", "extent"}
    for ablation, ablated in (("shared_scale", one_size), ("template_rt", {"frames"}), ("no_attention", {"attention"})):
        config = dataclasses.asdict(encoder_config("default", ablation))
        changed = {name for name, value in config.items() if default[name] != value}
        assert changed == ablated
