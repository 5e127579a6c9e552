"""The encoder's network: shapes, what reaches what, what learns, and what it refuses."""

import dataclasses

import pytest
import torch
from primdiffusion.body.model import BodyPose, J
from primdiffusion.encoder.blocks import ConcatenatedAttention, CrossModalAttention, UntiedConv
from primdiffusion.encoder.config import PRESETS, EncoderConfig, encoder_config
from primdiffusion.encoder.model import frames_of
from primdiffusion.encoder.network import Encoder, clamp, fill, voxels
from primdiffusion.encoder.unproject import Unprojected
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.primitives.primitives import GRID, K, Payload, S, pack
from support.errors import refused
from support.tiny import TINY

SMALL = {
    "stem": (2, 2, 4), "grid": (32, 8, 8), "motion": 32, "attention_width": 8, "attention_heads": 2, "fused": 4,
    "colour": (4, 2), "density": (4, 2), "finest": 2, "scale": (4, 4),
}  # fmt: skip


ARCHITECTURES = {
    **PRESETS,
    **{ablation: encoder_config("default", ablation) for ablation in ("shared_scale", "template_rt", "no_attention")},
    "paper without attention": encoder_config("paper", "no_attention"),
}


def small(name: str, **more) -> EncoderConfig:
    """An architecture with few channels."""
    return dataclasses.replace(ARCHITECTURES[name], **{**SMALL, **more})


def seen_from(config: EncoderConfig, people: int = 1, seed: int = 0) -> Unprojected:
    """As if somebody had been looked up: colours in blotches, half of all points unseen, some outside of the masks."""
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(people, 5 * config.layers, GRID, GRID, generator=generator)
    draws = torch.nn.functional.interpolate(draws, scale_factor=S, mode="bilinear")
    rgb, seen, covered = draws.mul(255).to(torch.uint8).split([3 * config.layers, config.layers, config.layers], 1)
    seen = torch.where(seen > 127, seen, 0)
    rgb = rgb.unflatten(1, (config.layers, 3)) * (seen > 0)[:, :, None]
    return Unprojected(rgb, seen, covered, torch.tensor(config.extent).expand(people, K, 3))


def poses(people: int = 1, seed: int = 0) -> torch.Tensor:
    return 0.5 * torch.randn(people, J, 3, generator=torch.Generator().manual_seed(seed))


def encoder_of(config: EncoderConfig, seed: int = 0) -> Encoder:
    """With weights as after some training: those that begin at zero no longer are."""
    torch.manual_seed(seed)
    encoder = Encoder(config)
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return encoder


def differs(a: Payload, b: Payload) -> bool:
    return any((x - y).abs().max() > 1e-6 for x, y in zip(vars(a).values(), vars(b).values(), strict=True))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_gives_a_payload(preset):
    config = PRESETS[preset]
    torch.manual_seed(0)
    with torch.no_grad():
        payload = Encoder(config)(seen_from(config), poses())
    assert payload.rgb.shape == (1, K, 3, S, S, S)
    payload.validate()
    assert payload.rgb.min() >= 0
    assert payload.rgb.max() <= 1
    assert payload.density.min() >= 0
    assert payload.density.max() <= config.full_density
    # The last layer's outputs are small at first.
    assert torch.allclose(payload.delta_scale, torch.tensor(config.extent).expand(1, K, 3), rtol=0.1)


@pytest.mark.parametrize("preset", ARCHITECTURES)
def test_gradients_reach_every_parameter(preset):
    config = small(preset)
    encoder = encoder_of(config)
    payload = encoder(seen_from(config), poses())
    weights = [torch.randn(value.shape) for value in vars(payload).values()]
    sum((w * v).sum() for w, v in zip(weights, vars(payload).values(), strict=True)).backward()
    still = {name for name, parameter in encoder.named_parameters() if not (parameter.grad.abs().max() > 0)}
    assert still == set()


def test_only_the_last_three_channels_of_the_released_scales_learn():
    config = small("released")
    encoder = encoder_of(config)
    encoder(seen_from(config), poses()).delta_scale.square().sum().backward()
    reached = encoder.scale_out.bias.grad.abs().flatten(1).amax(1) > 0
    assert reached.tolist() == [False] * 6 + [True] * 3


def test_attention_begins_as_nothing_and_learns_from_the_first_step_on():
    torch.manual_seed(0)
    config = small("default")
    encoder = Encoder(config)
    attention = encoder.attention
    a, m = torch.randn(1, 32, GRID, GRID), torch.randn(1, 32, GRID, GRID)
    assert all(torch.equal(x, y) for x, y in zip(attention(a, m), (a, m), strict=True))
    # Behind layers of zeros nothing gets a gradient until these have moved: at the first step they alone learn.
    encoder(seen_from(config), poses()).rgb.square().sum().backward()
    learning = {name for name, p in attention.named_parameters() if p.grad.abs().max() > 0}
    assert learning == {f"leave.{i}.{kind}" for i in range(2) for kind in ("weight", "bias")}


# What reaches what.


def mixed(kind: type) -> torch.nn.Module:
    torch.manual_seed(0)
    attention = kind(32, 32, 16, 2, 1)
    for leave in attention.leave if isinstance(attention.leave, torch.nn.ModuleList) else [attention.leave]:
        torch.nn.init.normal_(leave.weight)
    return attention


@pytest.mark.parametrize("kind", [CrossModalAttention, ConcatenatedAttention])
def test_attention_carries_each_branch_into_the_other(kind):
    attention, (a, m) = mixed(kind), torch.randn(2, 1, 32, 8, 8)
    other_a, other_m = a.clone(), m.clone()
    other_a[..., 0, 0] += 1
    other_m[..., 0, 0] += 1
    with torch.no_grad():
        before = attention(a, m)
        of_a, of_m = attention(other_a, m), attention(a, other_m)
    # Also at places far from the one that changed.
    assert (of_m[0] - before[0])[..., -1, -1].abs().max() > 1e-5
    assert (of_a[1] - before[1])[..., -1, -1].abs().max() > 1e-5


@pytest.mark.parametrize(
    ("preset", "entry", "reaches"),
    [("default", "residual", True), ("released", "halving", True), ("no_attention", "residual", False)],
)
def test_a_change_at_one_place_reaches_far_ones_only_through_attention(preset, entry, reaches):
    config = small(preset, grid=(32,), grid_entry=entry)
    encoder, found = encoder_of(config).double(), seen_from(config)
    changed = found.map(lambda tensor: tensor.clone())
    changed.rgb[..., :S, :S] = 255 - changed.rgb[..., :S, :S]
    changed.seen[..., :S, :S] = 255
    found.seen[..., :S, :S] = 255
    with torch.no_grad():
        before, after = (encoder(one, poses()) for one in (found, changed))
    far = [(x - y)[:, K // 2 :].abs().max() for x, y in zip(vars(before).values(), vars(after).values(), strict=True)]
    assert (max(far) > 1e-9) == reaches


@pytest.mark.parametrize("preset", ARCHITECTURES)
def test_the_pose_matters_but_not_the_turn_of_the_pelvis(preset):
    config = small(preset)
    encoder, found, pose = encoder_of(config), seen_from(config), poses()
    bent, turned = pose.clone(), pose.clone()
    bent[:, 18] += 1
    turned[:, 0] += 1
    with torch.no_grad():
        first = encoder(found, pose)
        assert differs(first, encoder(found, bent))
        assert not differs(first, encoder(found, turned))


def test_a_shared_scale_is_shared_by_all_boxes_and_differs_between_people():
    config = small("shared_scale")
    with torch.no_grad():
        scale = encoder_of(config)(seen_from(config, 2), poses(2)).delta_scale
        varying = encoder_of(small("default"))(seen_from(config, 2), poses(2)).delta_scale
    assert torch.equal(scale, scale[:, :1].expand_as(scale))
    assert (scale[0] - scale[1]).abs().max() > 1e-6
    assert varying.std(1).min() > 1e-4
    # The mean is that of logarithms.
    assert torch.allclose(scale[:, 0], varying.log().mean(1).exp(), atol=1e-5)


def test_template_frames_ignore_betas_and_personal_ones_do_not():
    betas, pose = torch.linspace(-2, 2, 10), BodyPose.rest()
    template, mean = (frames_of(ARCHITECTURES["template_rt"], b, pose)[1] for b in (betas, torch.zeros(10)))
    person = frames_of(PRESETS["default"], betas, pose)[1]
    assert torch.equal(template.position, mean.position)
    assert (person.position - mean.position).norm(dim=-1).max() > 0.01


def test_people_of_a_batch_do_not_reach_each_other():
    encoder, found, pose = encoder_of(TINY), seen_from(TINY, 3), poses(3)
    with torch.no_grad():
        together, alone = encoder(found, pose), encoder(found.map(lambda t: t[1:2]), pose[1:2])
    pairs = zip(vars(together).values(), vars(alone).values(), strict=True)
    assert all(torch.allclose(x[1:2], y, atol=2e-5) for x, y in pairs)


# What the values mean.


def test_voxels_have_the_channel_order_of_slabs():
    rgb = torch.rand(1, K, 3, S, S, S)
    slab = pack(Payload(rgb, torch.zeros(1, K, S, S, S), torch.ones(1, K, 3)), 100.0) / 0.182 / 2 + 0.5
    picture = slab.unflatten(1, (S, 7))[:, :, :3].flatten(1, 2)
    assert torch.allclose(voxels(picture, 3), encode_srgb(rgb), atol=1e-5)


def test_an_untrained_encoder_nearly_shows_what_it_was_given():
    config = small("default")
    found = seen_from(config)
    found = dataclasses.replace(found, seen=torch.full_like(found.seen, 255))
    torch.manual_seed(0)
    with torch.no_grad():
        payload = Encoder(config)(found, poses())
    given = voxels((found.rgb.float() / 255).flatten(1, 2), 3)
    assert (encode_srgb(payload.rgb) - given).abs().mean() < 0.05
    covered = voxels(found.covered.float() / 255, 1)[:, :, 0]
    assert payload.density[covered < 0.1].mean() < 0.1 * payload.density[covered > 0.99].mean()


def test_a_clamped_value_may_come_back_but_never_goes_farther_out():
    x = torch.tensor([-1.0, -1.0, 0.5, 0.5, 2.0, 2.0], requires_grad=True)
    up, down = torch.tensor([-1.0, 1.0] * 3), [-1.0, 0.0, -1.0, 1.0, 0.0, 1.0]
    value = clamp(x)
    value.backward(up)
    assert value.tolist() == [0, 0, 0.5, 0.5, 1, 1]
    assert x.grad.tolist() == down


def test_unseen_points_take_colours_from_around_and_seen_ones_keep_theirs():
    rgb, seen = torch.zeros(1, 2, 3, 16, 16), torch.zeros(1, 2, 16, 16)
    rgb[:, :, 0, :, :8], rgb[:, :, 2, :, 8:] = 1, 1  # red left, blue right
    seen[:, 0, 2:14, 2:14] = 1
    filled = fill(rgb * seen[:, :, None], seen)
    known = (seen > 0)[:, :, None].expand_as(rgb)
    assert torch.allclose(filled[known], rgb[known], atol=1e-6)
    column = filled[0, 1, :, 2:14, 2:14]
    assert torch.allclose(column, rgb[0, 0, :, 2:14, 2:14], atol=1e-6)  # of the same column, another layer
    assert filled[0, :, 0, :, 0].min() > 0.9  # beside red
    assert filled[0, :, 2, :, -1].min() > 0.9  # beside blue


def test_where_nothing_is_seen_at_all_colours_are_black_and_finite():
    filled = fill(torch.zeros(1, 1, 3, 16, 16), torch.zeros(1, 1, 16, 16))
    assert torch.equal(filled, torch.zeros_like(filled))


def test_the_architectures_of_the_paper_read_colours_alone():
    config = small("paper")
    encoder, found = encoder_of(config), seen_from(config)
    inputs, base = encoder.read(found)
    assert torch.equal(inputs, found.rgb[:, 0].float() / 255)
    assert torch.equal(base, torch.full_like(base, 100 / 255))
    assert encoder.stem[0].convolution.weight.shape[1] == 3


# Sizes of SPEC 2.


def channels(layers) -> list[int]:
    return [layer.bias.shape[0] for layer in layers]


@pytest.mark.parametrize(
    ("preset", "parameters"),
    [("default", 11_507_515), ("no_attention", 10_954_523), ("paper", 9_115_359), ("released", 7_190_747)],
)
def test_presets_have_the_size_that_the_documents_state(preset, parameters):
    with torch.device("meta"):
        encoder = Encoder(ARCHITECTURES[preset])
    assert sum(parameter.numel() for parameter in encoder.parameters()) == parameters


def test_the_papers_network_halves_to_one_texel_and_joins_its_input_at_the_end():
    config = small("paper", stem=(2, 2, 4), grid=(8,) * 6)
    network = encoder_of(config).appearance.double()
    x = torch.randn(1, 4, GRID, GRID, dtype=torch.float64)
    moved = x.clone()
    moved[..., 0, 0] += 1
    with torch.no_grad():
        change = (network(moved) - network(x)).abs().amax((0, 1))
        for layer in network.up:
            layer.bias.zero_()
            layer.convolution.parametrizations.weight.original0.zero_()
        direct = (network(moved) - network(x)).abs().amax((0, 1))
    assert change[-1, -1] > 0
    assert direct[0, 0] > 0
    assert direct.flatten()[1:].max() == 0


# Numbers and devices.


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-4), (torch.bfloat16, 0.1)])
def test_other_precisions_agree(dtype, tolerance):
    encoder, found, pose = encoder_of(TINY), seen_from(TINY), poses()
    with torch.no_grad():
        expected, given = encoder(found, pose), encoder.to(dtype)(found, pose)
    assert given.rgb.dtype == dtype
    for name, scale in (("rgb", 1), ("density", TINY.full_density), ("delta_scale", 1)):
        difference = (getattr(given, name).float() - getattr(expected, name)).abs().mean() / scale
        assert difference < tolerance, name


def test_bf16_autocast_trains():
    encoder = encoder_of(TINY)
    with torch.autocast("cpu", torch.bfloat16):
        payload = encoder(seen_from(TINY), poses())
    payload.density.float().square().mean().backward()
    assert all(torch.isfinite(p.grad).all() for p in encoder.parameters() if p.grad is not None)


@pytest.mark.parametrize("preset", ARCHITECTURES)
def test_nothing_in_the_network_chooses_a_device(preset):
    config = small(preset)
    with torch.device("meta"):
        encoder = Encoder(config)
    payload = encoder(seen_from(config).to("meta"), poses().to("meta"))
    assert payload.rgb.is_meta
    assert payload.density.is_meta


@pytest.mark.parametrize(("resize", "shape"), [("same", (5, 8, 8)), ("down", (5, 4, 4)), ("up", (5, 16, 16))])
def test_each_output_channel_of_a_convolution_has_one_gain(resize, shape):
    layer = UntiedConv(3, 5, shape[-1], resize)
    assert layer(torch.randn(2, 3, 8, 8)).shape == (2, *shape)
    assert layer.convolution.parametrizations.weight.original0.numel() == 5


# What it refuses.


def test_what_another_kind_of_encoder_looks_up_is_rejected():
    texels = dataclasses.replace(TINY, appearance="texels")
    with refused(ValueError, "voxels"):
        Encoder(TINY)(seen_from(texels), poses())
    with refused(ValueError, "texels"):
        Encoder(texels)(seen_from(TINY), poses())
    with refused(ValueError, "subjects"):
        Encoder(TINY)(seen_from(TINY).map(lambda tensor: tensor[0]), poses())
    with refused(ValueError, "256"):
        Encoder(TINY)(seen_from(TINY).map(lambda tensor: tensor[..., ::2, :]), poses())


def test_poses_must_be_as_many_as_people():
    with refused(ValueError, "2 subjects", "[2, 24, 3]"):
        Encoder(TINY)(seen_from(TINY, 2), poses(1))
