"""Cameras: the OpenCV convention, pixel centres at +0.5."""

import pytest
import torch
from primdiffusion.geometry.camera import look_at
from support.errors import refused


def front_camera(width: int = 64, height: int = 48):
    return look_at(torch.tensor([0.0, 1.0, 3.0]).double(), torch.tensor([0.0, 1.0, 0.0]).double(),
                   vertical_fov=0.8, width=width, height=height)  # fmt: skip


def test_the_target_lands_in_the_middle_of_the_picture():
    pixel, depth = front_camera().project(torch.tensor([0.0, 1.0, 0.0]).double())
    assert pixel.tolist() == [32.0, 24.0]
    assert depth.item() == pytest.approx(3.0)


def test_the_persons_left_is_on_the_right_of_a_front_view_and_up_is_up():
    camera = front_camera()
    left, _ = camera.project(torch.tensor([0.5, 1.0, 0.0]).double())
    up, _ = camera.project(torch.tensor([0.0, 1.5, 0.0]).double())
    assert left[0] > 32
    assert up[1] < 24


def test_rays_pass_through_the_points_that_project_to_their_pixel_centres():
    camera = front_camera()
    origin, direction = camera.rays()
    points = origin + 2.7 * direction
    pixel, _ = camera.project(points)
    v, u = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    torch.testing.assert_close(pixel, torch.stack([u, v], -1).double())
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(48, 64).double())


@pytest.mark.parametrize(("stride", "left", "top"), [(1, 0, 0), (3, 1, 0), (3, 2, 2)])
def test_every_third_pixel_keeps_its_ray(stride, left, top):
    eye, target = torch.tensor([0.4, 1.2, 2.0]), torch.tensor([0.0, 0.9, 0.0])
    camera = look_at(eye, target, vertical_fov=0.7, width=31, height=20)
    some = camera.every(stride, left, top)
    assert torch.equal(some.position, camera.position)
    torch.testing.assert_close(some.rays()[1], camera.rays()[1][top::stride, left::stride])


def test_the_vertical_field_of_view_spans_the_height():
    camera = front_camera()
    top = torch.tensor([0.0, 1.0 + 3.0 * torch.tan(torch.tensor(0.4)).item(), 0.0]).double()
    assert camera.project(top)[0][1].item() == pytest.approx(0.0, abs=1e-6)


def test_looking_along_up_is_rejected_with_a_remedy():
    with refused(ValueError, "points"):
        look_at(torch.tensor([0.0, 3.0, 0.0]), torch.zeros(3), vertical_fov=0.8, width=8, height=8)


def test_a_record_moves_between_dtypes_whole():
    camera = front_camera().to(dtype=torch.float32)
    assert camera.intrinsics.dtype == camera.world_to_camera.dtype == torch.float32
    assert camera.width == 64
