"""From pictures of a person to their payload."""

import dataclasses
import itertools

import pytest
import torch
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.reader import Views
from primdiffusion.encoder.model import encode, frames_of, look_up
from primdiffusion.encoder.network import Encoder
from primdiffusion.encoder.unproject import unproject_voxels
from primdiffusion.geometry.camera import look_at
from primdiffusion.primitives.primitives import Frames, K, S
from support.errors import refused
from tiny_encoder import TINY, tiny_encoder


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
        look_up(TINY, blank_views(), betas.reshape(-1) if betas.ndim > 1 else betas)


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
    found = look_up(encoder.config, views, betas)
    assert (payload.delta_scale / found.extent - 1).abs().max() < 0.1  # nothing is learned yet
    rest = Frames(drawn.position, drawn.rotation, drawn.half_extent / payload.delta_scale)
    there = unproject_voxels(views, vertices, rest, found.extent, encoder.config.facing)
    for name in ("rgb", "seen", "covered"):  # but for what a rounded bit puts on the other side of an edge
        assert (getattr(found, name) != getattr(there, name)).float().mean() < 1e-3, name
