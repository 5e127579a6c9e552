"""The released code's texture of the body: visibility on both sides, bilinear depth, erosion of masks (SPEC 2)."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyModel, BodyPose, J
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.reader import Views
from primdiffusion.encoder.config import RELEASED
from primdiffusion.encoder.model import unproject_views
from primdiffusion.encoder.texture import BESIDE, TEXTURE_SIDE, erode, sample_both_sides, unproject_texture
from primdiffusion.encoder.unproject import SIDE
from primdiffusion.geometry.camera import Camera, look_at
from scipy.ndimage import binary_erosion
from torch import Tensor

TOLERANCE = 0.020


def plate(z: float = 0.0, width: float = 1.0) -> BodyModel:
    """A square of a metre that faces +z; its chart has `width` of the UV square."""
    corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return BodyModel(
        template=torch.cat([corners - 0.5, torch.full((4, 1), z)], 1),
        shape_basis=torch.zeros(4, 3, 10),
        pose_basis=torch.zeros(4, 3, 0),
        joint_regressor=torch.full((J, 4), 0.25),
        skin_weights=torch.full((4, J), 1 / J),
        parents=torch.tensor([-1] + [0] * (J - 1)),
        faces=faces,
        uv=corners * torch.tensor([width, 1]),
        uv_faces=faces,
    )


def camera(yaw: float, pixels: int, fov: float = 0.6) -> Camera:
    position = 2 * torch.tensor([math.sin(yaw), 0.1, math.cos(yaw)])
    return look_at(position, torch.zeros(3), vertical_fov=fov, width=pixels, height=pixels)


def views_of(pictures: np.ndarray, cameras: list[Camera]) -> Views:
    return Views(torch.from_numpy(pictures), stack(cameras), BodyPose.rest())


def noise(views: int, pixels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (views, pixels, pixels, 4)).astype(np.uint8)


def brute_force(views: Views, depth: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour and number of views that see each point, one pixel corner at a time in float64."""
    colour, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for view, picture in enumerate(views.rgba.numpy().astype(np.float64)):
        one = views.camera.map(lambda tensor, view=view: tensor[view])
        world_to_camera = one.world_to_camera.double().numpy()
        inside = points @ world_to_camera[:, :3].T + world_to_camera[:, 3]
        pixel = inside @ one.intrinsics.double().numpy().T
        u, v = pixel[:, 0] / pixel[:, 2], pixel[:, 1] / pixel[:, 2]
        surface, found = np.zeros(len(points)), np.zeros((len(points), 3))
        for row in (0, 1):
            for column in (0, 1):
                x, y = np.floor(u - 0.5) + column, np.floor(v - 0.5) + row
                weight = (1 - abs(u - 0.5 - x)) * (1 - abs(v - 0.5 - y))
                at = tuple(np.clip(k, 0, picture.shape[0] - 1).astype(int) for k in (y, x))
                surface += weight * depth[view][at]
                found += weight[:, None] * picture[at][:, :3]
        seen = (abs(inside[:, 2] - surface) <= TOLERANCE) & (inside[:, 2] > 0)
        seen &= (u >= 0) & (v >= 0) & (u < picture.shape[1]) & (v < picture.shape[0])
        colour += np.where(seen[:, None], found, 0)
        count += seen
    return colour / np.maximum(count, 1)[:, None], count


def test_visibility_is_two_sided_in_bilinear_depth_as_by_brute_force():
    draws = np.random.default_rng(1)
    views = views_of(noise(3, 12), [camera(yaw, 12) for yaw in (-0.4, 0.1, 0.7)])
    depth = draws.uniform(1.97, 2.03, (3, 12, 12)).astype(np.float32)
    depth[:, 3:6, 4:9] = np.inf  # beside the body
    points = draws.uniform(-0.7, 0.7, (4000, 3)) * [1, 1, 0.05]
    beside = np.where(np.isfinite(depth), depth, BESIDE)
    colour, count = brute_force(views, beside, points)
    rgb, share = sample_both_sides(views, depth, torch.from_numpy(points))
    assert {0, 1, 2} <= set(count)
    np.testing.assert_allclose(share.numpy(), count / 3, atol=1e-6)
    np.testing.assert_allclose(rgb.numpy(), colour, atol=1e-4)


@pytest.mark.parametrize(("front", "seen"), [(0.015, 1), (0.025, 0), (-0.015, 1), (-0.025, 0)])
def test_a_point_in_front_of_the_surface_is_hidden_as_one_behind(front, seen):
    views = views_of(
        noise(1, 8), [look_at(torch.tensor([0.0, 0, 2]), torch.zeros(3), vertical_fov=0.6, width=8, height=8)]
    )
    depth = np.full((1, 8, 8), 2, np.float32)
    assert sample_both_sides(views, depth, torch.tensor([[0.05, 0.05, front]]))[1].tolist() == [seen]


def resized(texture: Tensor) -> Tensor:
    """A texture [3, 512, 512] at 256 x 256: bilinear, corner texels map to corner texels."""
    at = torch.arange(256).double() * (511 / 255)
    low = at.long().clamp(max=510)
    share = at - low
    x = texture.double()
    x = x[:, low] * (1 - share)[:, None] + x[:, low + 1] * share[:, None]
    return x[..., low] * (1 - share) + x[..., low + 1] * share


def test_the_texture_is_sampled_at_512_and_resized_with_corners_aligned():
    body = plate(width=0.75)
    views = views_of(noise(2, 16), [camera(yaw, 16) for yaw in (-0.3, 0.3)])
    found = unproject_texture(views, body.template, body)
    at = (np.arange(TEXTURE_SIDE) + 0.5) / TEXTURE_SIDE
    u, v = np.meshgrid(at, at)
    nearest = np.minimum(u, u[u < 0.75].max())  # of texels beside the chart: the last column that it covers
    points = np.stack([nearest / 0.75 - 0.5, v - 0.5, 0 * u], -1).reshape(-1, 3)
    depth = []  # of the plane z = 0
    for view in range(2):
        one = views.camera.map(lambda tensor, view=view: tensor[view].double())
        pixels = np.stack([*np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5), np.ones((16, 16))], -1)
        rotation, shift = one.world_to_camera[:, :3].numpy(), one.world_to_camera[:, 3].numpy()
        rays = pixels @ np.linalg.inv(one.intrinsics.numpy()).T @ rotation
        origin = -rotation.T @ shift
        along = -origin[2] / rays[..., 2]
        on_plate = abs(origin[:2] + along[..., None] * rays[..., :2]).max(-1) <= 0.5
        depth.append(np.where(on_plate, along, BESIDE))
    colour, count = brute_force(views, np.stack(depth), points)
    texture = torch.from_numpy(colour.T.reshape(3, TEXTURE_SIDE, TEXTURE_SIDE))
    difference = (found.rgb[0].double() - resized(texture)).abs()
    assert found.rgb.shape == (1, 3, SIDE, SIDE)
    assert (difference < 1e-2).double().mean() > 0.999  # depths at the limit may fall on either side
    assert (count > 0).mean() > 0.5


def test_erosion_is_that_of_scipy_once_by_3_x_3():
    views = views_of(noise(2, 20), [camera(yaw, 20) for yaw in (0.0, 1.0)])
    draws = np.random.default_rng(2)
    mask = np.where(draws.random((2, 20, 20)) < 0.9, draws.integers(1, 256, (2, 20, 20)), 0)
    views.rgba[..., 3] = torch.from_numpy(mask)
    found = erode(views).rgba.numpy()
    keep = np.stack([binary_erosion(one > 0, np.ones((3, 3)), border_value=1) for one in mask])
    assert 0.1 < keep.mean() < 0.9
    np.testing.assert_array_equal(found, views.rgba.numpy() * keep[..., None])


def test_masks_are_eroded_only_if_the_configuration_says_so():
    views = views_of(noise(1, 32), [camera(0.0, 32, 1.2)])
    views.rgba[..., 3] = 0
    views.rgba[:, 8:24, 8:24, 3] = 255
    whole = dataclasses.replace(RELEASED, masks="whole")
    betas = torch.zeros(10)
    expected = unproject_views(whole, erode(views), betas)
    found = unproject_views(RELEASED, views, betas)
    assert torch.equal(found.rgb, expected.rgb)
    assert not torch.equal(found.rgb, unproject_views(whole, views, betas).rgb)


def test_pixels_beside_the_person_are_black_and_count():
    """As the released code's: its pictures have a black background, and only depth hides."""
    body = plate()
    pictures = np.full((2, 8, 8, 4), 200, np.uint8)
    pictures[1] = 0
    views = views_of(
        pictures, [look_at(torch.tensor([0.0, 0, 2]), torch.zeros(3), vertical_fov=0.4, width=8, height=8)] * 2
    )
    found = unproject_texture(views, body.template, body).rgb[0, :, SIDE // 2, SIDE // 2]
    torch.testing.assert_close(found, torch.full((3,), 100.0))
