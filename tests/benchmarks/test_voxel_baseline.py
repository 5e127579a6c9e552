"""People as grids of voxels, and the baseline that diffuses them."""

import numpy as np
import pytest
import torch
from primdiffusion.geometry.camera import look_at
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.march import MarchSettings, march
from voxel_baseline import (
    SIDE,
    VoxelCodec,
    fit_voxel_codec,
    primitives_of,
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
