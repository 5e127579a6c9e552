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
    """Chain each joint's rotation, relative to its parent, down the skeleton; a parent comes before its children.

    In the rest pose a joint's axes are the world's, so its matrix is a pure translation.
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
    """What each joint does to points given in the rest pose: move the joint to the origin first."""
    rotation = world_from_joint[..., :3, :3]
    moved_rest = (rotation @ rest_joints[..., None])[..., 0]
    return rigid_matrix(rotation, world_from_joint[..., :3, 3] - moved_rest)


def relative_rotations(skinning: Float[Tensor, "*b J r 4"], parents: Sequence[int]) -> Float[Tensor, "*b J 3 3"]:
    """The joints' rotations relative to their parents, out of any affine matrices world <- rest.

    Each matrix counts as its nearest orthogonal one (`polar`); a rest pose has no rotations, so these are the joints'.
    """
    world, _ = polar(skinning[..., :3, :3])
    parent = [world[..., max(p, 0), :, :] for p in parents]
    relative = torch.stack(parent, dim=-3).mT @ world
    roots = torch.tensor([p < 0 for p in parents], device=world.device)
    return torch.where(roots[:, None, None], world, relative)


def skin(
    points: Float[Tensor, "*#b V 3"], weights: Float[Tensor, "V J"], skinning: Float[Tensor, "*#b J r 4"]
) -> Float[Tensor, "... V 3"]:
    """Points moved by the weighted mean of the joints' matrices (linear blend skinning)."""
    blended = torch.einsum("vj,...jrc->...vrc", weights, skinning[..., :3, :])
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]
