"""Stage 1 as imported against a second one, written in float64 from SPEC 2 alone."""

import math

import pytest
import torch
from primdiffusion.body.model import J
from primdiffusion.encoder.config import RELEASED
from primdiffusion.encoder.network import Encoder
from primdiffusion.encoder.unproject import SIDE, Unprojected
from primdiffusion.primitives.primitives import K, Payload
from primdiffusion.released.stage_one import encoder_tensors
from released_files import random_stage_one, template
from stage_one_twin import Slabs, StageOneTwin


def imported(tensors: dict[str, torch.Tensor]) -> Encoder:
    encoder = Encoder(RELEASED)
    encoder.load_state_dict(encoder_tensors(tensors))
    return encoder.eval().requires_grad_(False)


def inputs(seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """A texture with black parts, and theta."""
    generator = torch.Generator().manual_seed(seed)
    texture = 255 * torch.rand(3, SIDE, SIDE, generator=generator)
    texture[:, :, 150:] = 0
    return texture, 0.7 * torch.randn(J, 3, generator=generator)


def run(encoder: Encoder, texture: torch.Tensor, theta: torch.Tensor) -> Payload:
    whole = torch.full((1, 1, SIDE, SIDE), 255, dtype=torch.uint8)
    return encoder(Unprojected(texture[None, None], whole, whole, torch.ones(1, K, 3)), theta[None]).map(
        lambda value: value[0]
    )


def converted(slabs: Slabs) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """In our conventions (SPEC 1): linear colours, density in 1/m, larger delta scales are larger, B = N x T."""
    encoded = slabs.colour / 255
    linear = torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear.flip(-2), slabs.density.flip(-2) * (25.5 / 255), 1 / slabs.delta_s


def stage_one_error(seed: int = 0) -> float:
    """Largest difference between the two, relative to the range of each output."""
    tensors = random_stage_one(template(), seed)
    texture, theta = inputs()
    ours = run(imported(tensors), texture, theta)
    rgb, density, delta_scale = converted(StageOneTwin(tensors)(texture, theta.flatten()))
    return max(
        float((ours.rgb - rgb).abs().max()),
        float((ours.density - density).abs().max()) / 25.5,
        float((ours.delta_scale / delta_scale - 1).abs().max()),
    )


def attention_error(seed: int = 0) -> float:
    """Largest difference of the self-attention over [motion, appearance] alone, relative to the largest output."""
    tensors = random_stage_one(template(), seed)
    x = torch.randn(2, 96, 32, 32, generator=torch.Generator().manual_seed(seed))
    motion, appearance = x.split((32, 64), dim=1)
    ours = torch.cat(imported(tensors).attention(motion, appearance), dim=1)
    found = StageOneTwin(tensors).transformer(x.double())
    return float((ours - found).abs().max() / found.abs().max())


def test_the_imported_encoder_computes_what_the_reference_says():
    assert stage_one_error() < 1e-5


def test_its_attention_alone_computes_what_the_reference_says():
    assert attention_error() < 1e-5


def test_the_twin_uses_its_whole_range_so_that_it_can_tell_a_mistake():
    texture, theta = inputs()
    slabs = StageOneTwin(random_stage_one(template()))(texture, theta.flatten())
    for values in (slabs.colour, slabs.density):
        inside = (values > 0) & (values < 255)
        assert inside.double().mean() > 0.5
        assert values[inside].std() > 20
    assert slabs.delta_s.std() > 1e-3


def test_layers_of_the_same_shape_are_not_interchangeable():
    tensors = random_stage_one(template())
    first, second = "decoder_motion.0.", "decoder_motion.3."
    other = {name: tensors[name.replace(first, second)] for name in tensors if name.startswith(first)}
    a, b = (run(imported(one), *inputs()).delta_scale for one in (tensors, tensors | other))
    assert (a - b).abs().max() > 1e-3


def test_a_weight_is_normalised_over_the_whole_tensor():
    tensors = random_stage_one(template())
    encoder = imported(tensors)
    for layer, name, axis in (
        (encoder.fuse.first, "joint_conv_block.conv1", 0),
        (encoder.colour.up[1], "decoder_rgb.1", 1),
    ):
        direction, gain = tensors[f"{name}.weight"], tensors[f"{name}.g"]
        channel = direction.select(axis, 3)
        wanted = gain[3] * channel / math.sqrt(float(direction.double().square().sum()))
        torch.testing.assert_close(layer.convolution.weight.select(axis, 3), wanted)
        assert layer.convolution.weight.norm() == pytest.approx(
            float((direction * shaped(gain, axis)).norm() / direction.norm())
        )


def shaped(gain: torch.Tensor, axis: int) -> torch.Tensor:
    return gain.view(*(-1 if number == axis else 1 for number in range(4)))


def test_an_untrained_encoder_has_no_gain_that_its_directions_do_not_have():
    torch.manual_seed(0)
    layer = Encoder(RELEASED).stem[0].convolution
    gain, direction = (layer.get_parameter(f"parametrizations.weight.original{n}") for n in range(2))
    torch.testing.assert_close(gain, direction.norm().expand_as(gain))
