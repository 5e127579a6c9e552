"""Rotations: against scipy, and at the dangerous places (zero and half turns)."""

import math

import pytest
import torch
from primdiffusion.geometry.rotation import axis_angle_to_matrix, matrix_to_axis_angle, skew
from scipy.spatial.transform import Rotation


def axis_angles(count: int = 200, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    return axis * (torch.rand(count, 1, generator=generator, dtype=torch.float64) * math.pi)


def test_axis_angle_to_matrix_equals_scipy():
    v = axis_angles()
    expected = torch.from_numpy(Rotation.from_rotvec(v.numpy()).as_matrix())
    torch.testing.assert_close(axis_angle_to_matrix(v), expected, atol=1e-13, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1e-3, 1.0, math.pi - 1e-4, math.pi - 1e-8])
def test_the_logarithm_inverts_the_exponential_at_every_angle(angle):
    v = torch.nn.functional.normalize(axis_angles(), dim=-1) * angle
    torch.testing.assert_close(matrix_to_axis_angle(axis_angle_to_matrix(v)), v, atol=2e-8, rtol=0)


def test_half_turns_keep_their_axis_up_to_sign():
    v = torch.nn.functional.normalize(axis_angles(), dim=-1) * math.pi
    back = matrix_to_axis_angle(axis_angle_to_matrix(v))
    torch.testing.assert_close((back * v).sum(-1).abs(), torch.full((200,), math.pi**2, dtype=torch.float64))


def test_gradients_are_right_through_zero_rotation():
    v = torch.cat([torch.zeros(1, 3), 1e-5 * torch.ones(1, 3), torch.tensor([[0.4, -1.0, 2.0]])]).double()
    torch.autograd.gradcheck(axis_angle_to_matrix, v.requires_grad_())


def test_skew_is_the_cross_product():
    a, b = axis_angles(10), axis_angles(10, seed=1)
    torch.testing.assert_close((skew(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b))
