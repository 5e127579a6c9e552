"""Cameras: the OpenCV convention, pixel centres at +0.5."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float
from primdiffusion.geometry.camera import look_at
from primdiffusion.geometry.records import TensorRecord, check_shapes
from primdiffusion.geometry.rotation import axis_angle_to_matrix, matrix_to_axis_angle
from scipy.spatial.transform import Rotation
from support.errors import refused
from torch import Tensor


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
    depth = camera.project(origin + camera.secants()[..., None] * direction)[1]
    torch.testing.assert_close(depth, torch.ones(48, 64).double())


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


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(any), st.one_of(st.floats(0, math.pi - 1e-8), st.floats(0, 1e-3)))
def test_a_rotation_is_scipys_and_its_axis_and_angle_come_back(axis, angle):
    v = torch.tensor(axis, dtype=torch.float64)
    v = torch.nn.functional.normalize(v / v.abs().max(), dim=-1) * angle
    matrix = axis_angle_to_matrix(v)
    torch.testing.assert_close(
        matrix, torch.from_numpy(Rotation.from_rotvec(v.numpy()).as_matrix()), atol=1e-13, rtol=0
    )
    torch.testing.assert_close(matrix_to_axis_angle(matrix), v, atol=2e-8, rtol=0)


def test_half_turns_keep_their_axis_up_to_sign():
    directions = torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    v = torch.nn.functional.normalize(directions, dim=-1) * math.pi
    back = matrix_to_axis_angle(axis_angle_to_matrix(v))
    torch.testing.assert_close((back * v).sum(-1).abs(), torch.full((200,), math.pi**2, dtype=torch.float64))


def test_gradients_are_right_through_zero_rotation():
    v = torch.cat([torch.zeros(1, 3), 1e-5 * torch.ones(1, 3), torch.tensor([[0.4, -1.0, 2.0]])]).double()
    torch.autograd.gradcheck(axis_angle_to_matrix, v.requires_grad_())


@dataclasses.dataclass(frozen=True)
class Rows(TensorRecord):
    rows: Float[Tensor, "n 3"]
    weight: Float[Tensor, "n"]
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Pairs(TensorRecord):
    pairs: Float[Tensor, "n n"]


def test_a_name_is_one_size_in_all_records():
    check_shapes(Rows(torch.zeros(4, 3), torch.zeros(4)), Pairs(torch.zeros(4, 4)))
    check_shapes(Rows(torch.zeros(0, 3), torch.zeros(0)))


@pytest.mark.parametrize(
    ("records", "name"),
    [
        ([Rows(torch.zeros(4, 2), torch.zeros(4))], "rows"),
        ([Rows(torch.zeros(4, 3), torch.zeros(1))], "weight"),
        ([Rows(torch.zeros(4, 3), torch.zeros(()))], "weight"),
        ([Rows(torch.zeros(4, 3), torch.zeros(4, dtype=torch.int64))], "weight"),
        ([Rows(torch.zeros(4, 3), torch.zeros(4)), Pairs(torch.zeros(5, 5))], "pairs"),
        ([Pairs(torch.zeros(4, 5))], "pairs"),
    ],
)
def test_other_shapes_and_types_are_named(records, name):
    with refused(ValueError, name):
        check_shapes(*records)
