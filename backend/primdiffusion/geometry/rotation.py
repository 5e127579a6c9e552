"""Rotations as 3x3 matrices; axis-angle vectors (radians) appear only where files are read and written."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def skew(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The matrix [v]x with [v]x w = v x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rodrigues' formula; smooth (values and gradients) through the zero rotation."""
    angle_squared = axis_angle.square().sum(-1)[..., None, None]
    small = angle_squared < 1e-6
    angle = torch.where(small, torch.ones_like(angle_squared), angle_squared).sqrt()
    sin_over_angle = torch.where(small, 1 - angle_squared / 6, angle.sin() / angle)
    one_minus_cos = torch.where(small, 0.5 - angle_squared / 24, (1 - angle.cos()) / angle.square())
    k = skew(axis_angle)
    eye = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return eye + sin_over_angle * k + one_minus_cos * (k @ k)


def matrix_to_axis_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """The logarithm of a rotation, angle in [0, pi]; exact near 0 and near pi. Not differentiable at pi.

    Computed from the quaternion with the largest diagonal component, to avoid division by small numbers.
    """
    m = rotation
    t = torch.stack(
        [
            1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2],
            1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2],
            1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2],
        ],
        dim=-1,
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([t[..., 0], a, b, c], -1),
            torch.stack([a, t[..., 1], d, e], -1),
            torch.stack([b, d, t[..., 2], f], -1),
            torch.stack([c, e, f, t[..., 3]], -1),
        ],
        dim=-2,
    )
    largest = t.argmax(-1)[..., None, None].expand(*t.shape[:-1], 1, 4)
    quaternion = torch.nn.functional.normalize(candidates.gather(-2, largest).squeeze(-2), dim=-1)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w, v = quaternion[..., 0], quaternion[..., 1:]
    sin_half = v.norm(dim=-1)
    half_angle = torch.atan2(sin_half, w)
    scale = torch.where(sin_half < 1e-7, 2 * torch.ones_like(w), 2 * half_angle / sin_half.clamp_min(1e-12))
    return v * scale[..., None]


def polar(matrix: Float[Tensor, "*b 3 3"]) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3 3"]]:
    """Q and P of matrix = Q P: Q the nearest orthogonal matrix, P symmetric with det P = |det matrix|.

    Q reflects where the matrix does (det Q = -1). Differentiable where the singular values differ.
    """
    left, scales, right = torch.linalg.svd(matrix)
    return left @ right, right.mT @ (scales[..., None] * right)
