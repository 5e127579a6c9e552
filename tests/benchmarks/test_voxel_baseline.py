"""People as grids of voxels, and the baseline that diffuses them."""

import numpy as np
import pytest
import torch
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.geometry.camera import look_at
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.march import MarchSettings, march
from support.priors import of_whole_body
from voxel_baseline import (
    BOUNDS,
    SIDE,
    VoxelCodec,
    VoxelModel,
    VoxelUNetConfig,
    fit_voxel_codec,
    load_voxel_model,
    primitives_of,
    save_voxel_model,
    voxel_denoiser,
    voxelise_payload,
)

FULL = 100.0


pytestmark = pytest.mark.usefixtures("one_thread")


def boxes(*centres: tuple[float, float, float], half: float = 0.25) -> Frames:
    turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    count = len(centres)
    return Frames(torch.tensor(centres), turn.expand(count, 3, 3), torch.full((count, 3), half))


def plain(count: int, rgb: tuple[float, float, float], density: float) -> Payload:
    colour = torch.tensor(rgb)[None, :, None, None, None].expand(count, 3, 8, 8, 8)
    return Payload(colour.contiguous(), torch.full((count, 8, 8, 8), density), torch.ones(count, 3))


def places() -> torch.Tensor:
    low, high = torch.tensor(BOUNDS)
    axes = [torch.linspace(float(low[i]), float(high[i]), SIDE) for i in range(3)]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return torch.stack([x, y, z], dim=-1)


def test_a_box_is_where_it_stands_in_its_colour():
    frames, payload = boxes((0.3, -0.4, 0.05)), plain(1, (0.5, 0.2, 0.1), 60.0)
    grid = voxelise_payload(frames, payload, FULL).float() / 255
    far = (places() - frames.position[0]).norm(dim=-1)
    inside, outside = grid[far < 0.1], grid[far > 0.45]
    assert torch.allclose(inside[:, 3], torch.tensor(0.6), atol=0.01)
    assert torch.allclose(inside[:, :3], encode_srgb(torch.tensor([0.5, 0.2, 0.1])), atol=0.01)
    assert outside[:, 3].max() == 0


def test_where_boxes_overlap_densities_add_and_colours_mix_by_density():
    frames = boxes((0.0, 0.0, 0.05), (0.0, 0.0, 0.05))
    red, blue = plain(1, (1.0, 0.0, 0.0), 30.0), plain(1, (0.0, 0.0, 1.0), 10.0)
    both = Payload(*(torch.cat([getattr(one, name) for one in (red, blue)]) for name in vars(red)))
    grid = voxelise_payload(frames, both, FULL).float() / 255
    near = grid[(places() - frames.position[0]).norm(dim=-1) < 0.1]
    assert torch.allclose(near[:, 3], torch.tensor(0.4), atol=0.02)
    assert torch.allclose(decode_srgb(near[:, :3]), torch.tensor([0.75, 0.0, 0.25]), atol=0.01)


def test_a_grid_is_drawn_as_the_boxes_it_was_gathered_from():
    frames, payload = boxes((0.2, -0.5, 0.05), (-0.4, 0.3, 0.02), half=0.22), plain(2, (0.8, 0.3, 0.1), 80.0)
    camera = look_at(
        torch.tensor([0.0, -0.3, 6.0]), torch.tensor([0.0, -0.3, 0.0]), vertical_fov=0.4, width=64, height=64
    )
    grid = voxelise_payload(frames, payload, FULL).float() / 255
    given, drawn = (
        march(primitives, camera, MarchSettings(step=0.008))
        for primitives in (Primitives.place(frames, payload), primitives_of(grid, FULL))
    )
    assert float((given.alpha - drawn.alpha).abs().mean()) < 0.02
    solid = (given.alpha > 0.99) & (drawn.alpha > 0.99)
    assert int(solid.sum()) > 100
    assert torch.allclose(given.rgb[solid], drawn.rgb[solid], atol=0.02)


def people(count: int) -> list[torch.Tensor]:
    rng = np.random.default_rng(0)
    grids = torch.zeros(count, 2, SIDE, SIDE, SIDE, 4, dtype=torch.uint8)
    for one in grids:
        one[..., :3] = 128
        one[:, 20:40, 8:30, 24:44] = torch.from_numpy(rng.integers(0, 255, (2, 1, 1, 1, 4)).astype(np.uint8))
    return list(grids)


@pytest.fixture(scope="module")
def codec() -> VoxelCodec:
    return fit_voxel_codec(lambda: people(6), 16)


def test_codec_gives_back_what_lies_in_its_basis(codec):
    grid = people(6)[2]
    decoded = codec.decode(codec.encode(grid))
    solid = grid[..., 3] > 60
    wanted = grid[..., :3].float() / 255
    assert float((decoded[..., :3] - wanted)[solid].abs().mean()) < 0.02
    assert float((decoded[..., 3] * solid).sum() / solid.sum()) > 0.2
    assert torch.allclose(codec.basis @ codec.basis.T, torch.eye(16), atol=1e-5)


@pytest.fixture(scope="module")
def model(codec) -> VoxelModel:
    shape = (16, len(codec.cells), 1)
    size, generator = shape[0] * shape[1], torch.Generator().manual_seed(0)
    prior = of_whole_body(
        mean=torch.zeros(shape),
        basis=torch.linalg.qr(torch.randn(size, 3, generator=generator))[0].T.contiguous(),
        parity=torch.ones(3),
        rest_variance=torch.full(shape, 0.01),
        log_weight=torch.zeros(1, 1),
        centre=torch.zeros(1, 1, 3),
        axes=torch.eye(3)[None],
        variance=torch.ones(1, 3),
        kind=torch.zeros(1, 1, 0),
    )
    denoiser = voxel_denoiser(prior, codec, VoxelUNetConfig())
    shapes = ShapePrior(torch.ones(10, 2), torch.zeros(10), torch.eye(10), torch.full((10,), 3.0))
    return VoxelModel(denoiser, codec, shapes, FULL, {"steps": {"local": 1}})


def test_untrained_network_leaves_the_closed_form_and_trained_does_not(model):
    x = torch.randn(2, *model.denoiser.prior.mean.shape)
    t = torch.tensor([100, 700])
    signal, noise = model.denoiser.schedule.levels(t, x)
    assert torch.allclose(model.denoiser(x, t), model.denoiser.prior.denoise(x, signal, noise), atol=1e-5)
    before = model.denoiser.local.outer.weight.clone()
    torch.nn.init.normal_(model.denoiser.local.outer.weight, std=0.1)
    changed = model.denoiser(x, t)
    model.denoiser.local.outer.weight.copy_(before)
    assert not torch.allclose(changed, model.denoiser.prior.denoise(x, signal, noise), atol=1e-2)


def test_baseline_is_stored_whole(model, tmp_path):
    save_voxel_model(tmp_path / "voxel.safetensors", model)
    again = load_voxel_model(tmp_path / "voxel.safetensors")
    assert again.card == model.card
    assert torch.equal(next(again.sample([1], steps=2)).grid, next(model.sample([1], steps=2)).grid)
    assert torch.equal(again.shapes.scale, model.shapes.scale)
