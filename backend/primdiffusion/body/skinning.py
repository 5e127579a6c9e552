"""Forward kinematics and linear blend skinning (Loper et al. 2015, SMPL, eqs. 2-4 and 7)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.rotation import polar


def rigid_matrix(rotation: Float[Tensor, "*#b 3 3"], translation: Float[Tensor, "*#b 3"]) -> Float[Tensor, "... 4 4"]:
    """The 4x4 matrix of x -> rotation @ x + translation; batches broadcast."""
    batch = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    top = torch.cat([rotation.expand(*batch, 3, 3), translation.expand(*batch, 3)[..., None]], dim=-1)
    last_row = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*batch, 1, 4)
    return torch.cat([top, last_row], dim=-2)


def world_from_joints(
    joint_rotation: Float[Tensor, "*#b J 3 3"], rest_joints: Float[Tensor, "*#b J 3"], parents: Sequence[int]
) -> Float[Tensor, "... J 4 4"]:
    """Forward kinematics: chain the joints' rotations relative to their parents; parents precede their children.

    In the rest pose joint axes are the world axes, so each matrix is a pure translation.
    """
    bones = torch.stack(
        [rest_joints[..., j, :] - (rest_joints[..., p, :] if p >= 0 else 0) for j, p in enumerate(parents)], dim=-2
    )
    parent_from_joint = rigid_matrix(joint_rotation, bones)
    world: list[Tensor] = []
    for j, parent in enumerate(parents):
        local = parent_from_joint[..., j, :, :]
        world.append(local if parent < 0 else world[parent] @ local)
    return torch.stack(world, dim=-3)


def world_from_rest(
    world_from_joint: Float[Tensor, "*#b J 4 4"], rest_joints: Float[Tensor, "*#b J 3"]
) -> Float[Tensor, "... J 4 4"]:
    """Transforms of the joints for rest points: move the joint to the origin, then apply its world matrix."""
    rotation = world_from_joint[..., :3, :3]
    moved_rest = (rotation @ rest_joints[..., None])[..., 0]
    return rigid_matrix(rotation, world_from_joint[..., :3, 3] - moved_rest)


def relative_rotations(skinning: Float[Tensor, "*b J r 4"], parents: Sequence[int]) -> Float[Tensor, "*b J 3 3"]:
    """Joint rotations relative to their parents, from arbitrary affine matrices world <- rest.

    Each matrix is replaced by the nearest orthogonal one (`polar`). Joints are not rotated in the rest pose, so that is
    the joint's world rotation.
    """
    world, _ = polar(skinning[..., :3, :3])
    parent = [world[..., max(p, 0), :, :] for p in parents]
    relative = torch.stack(parent, dim=-3).mT @ world
    roots = torch.tensor([p < 0 for p in parents], device=world.device)
    return torch.where(roots[:, None, None], world, relative)


def skin(
    points: Float[Tensor, "*#b V 3"], weights: Float[Tensor, "V J"], skinning: Float[Tensor, "*#b J r 4"]
) -> Float[Tensor, "... V 3"]:
    """Linear blend skinning: transform points by the weighted mean of the joints' matrices."""
    blended = torch.einsum("vj,...jrc->...vrc", weights, skinning[..., :3, :])
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]
