"""Forward kinematics and linear blend skinning (Loper et al. 2015, SMPL, eqs. 2-4 and 7), and poses of files."""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.files.arrays import read_arrays
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.poses import files
from primdiffusion.formats.poses.motion import Motion
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.rotation import axis_angle_to_matrix, polar

DENSITY = 985.0
"""kg/m^3 of a living human with air in the lungs."""
MOST_CORRECTIONS = 20
LARGEST_BETA = 5.0
"""Linear shape models produce broken bodies beyond this value."""


class Measures(NamedTuple):
    """Measures of a body without clothes."""

    height: float
    """Metres."""
    weight: float
    """Kilograms, from the volume and DENSITY."""


def measure(shape: ShapedBody) -> Measures:
    """Height and weight of an unbatched body in its rest pose."""
    vertices = shape.vertices.detach().double()
    height = float(vertices[:, 1].amax() - vertices[:, 1].amin())
    a, b, c = (vertices[shape.model.faces[:, i].long()] for i in range(3))
    volume = float((a * torch.linalg.cross(b, c)).sum()) / 6  # sum of signed tetrahedra to the origin
    return Measures(height, abs(volume) * DENSITY)


def betas_of_measures(
    betas: Float[Tensor, "n"],
    scale: Float[Tensor, "n n"],
    body: BodyModel,
    height: float | None = None,
    weight: float | None = None,
) -> Float[Tensor, "n"]:
    """Change betas as little as possible so that the body has the given height (m) and weight (kg).

    Distance is the Mahalanobis distance of N(., scale scale^T), the distribution that `betas` were sampled from. As far
    as measures are linear in betas, the result is a sample of that distribution conditioned on the measures (Matheron's
    rule); Newton steps correct the rest. Accurate to 0.1 mm and 10 g. Raises ValueError if no body within LARGEST_BETA
    has these measures.
    """
    wanted = [(number, value) for number, value in enumerate((height, weight)) if value is not None]
    if not wanted:
        return betas
    rows = [number for number, _ in wanted]
    target = torch.tensor([value for _, value in wanted], dtype=torch.float64)
    tolerance = torch.tensor([1e-4, 1e-2], dtype=torch.float64)[rows]
    moved, covariance = betas.double(), (scale @ scale.T).double().cpu()
    for _ in range(MOST_CORRECTIONS):
        missing = target - _measured(moved, body)[rows]
        if (missing.abs() < tolerance).all():
            break
        slope = _slope(moved, body)[rows]
        moved = moved + covariance @ slope.T @ torch.linalg.solve(slope @ covariance @ slope.T, missing)
        if not moved.abs().amax() <= LARGEST_BETA:
            break
    else:
        moved = moved * torch.inf
    if not moved.abs().amax() <= LARGEST_BETA:
        names = (("a height of {:.2f} m", height), ("a weight of {:.0f} kg", weight))
        asked = " with ".join(text.format(value) for text, value in names if value is not None)
        raise ValueError(f"no body of this model has {asked}: choose less extreme values")
    return moved.to(betas)


def _measured(betas: Float[Tensor, "n"], body: BodyModel) -> Float[Tensor, "2"]:
    return torch.tensor(measure(body.shape(betas.to(body.template))), dtype=torch.float64)


def _slope(betas: Float[Tensor, "n"], body: BodyModel, step: float = 0.05) -> Float[Tensor, "2 n"]:
    """Central differences of the measures with respect to each beta."""
    moves = step * torch.eye(len(betas), dtype=torch.float64)
    return torch.stack([(_measured(betas + m, body) - _measured(betas - m, body)) / (2 * step) for m in moves], dim=1)


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


J = len(JOINT_NAMES)
"""Joints of a body."""


@dataclasses.dataclass(frozen=True)
class BodyPose(TensorRecord):
    """Joint rotations and translation, independent of the body's shape.

    >>> pd.BodyPose.rest().joint_rotation.shape
    torch.Size([24, 3, 3])
    """

    joint_rotation: Float[Tensor, "*b J 3 3"]
    """Rotation of each joint relative to its parent; the first rotates the whole body about the pelvis."""
    translation: Float[Tensor, "*b 3"]
    """Translation of the whole body, metres, applied after the rotations."""

    @classmethod
    def rest(
        cls, *batch: int, dtype: torch.dtype = torch.float32, device: torch.device | str | None = None
    ) -> BodyPose:
        """The T pose of the template, with the given batch shape."""
        return cls(
            torch.eye(3, dtype=dtype, device=device).expand(*batch, J, 3, 3),
            torch.zeros(*batch, 3, dtype=dtype, device=device),
        )

    @classmethod
    def from_axis_angle(
        cls, theta: Float[Tensor, "*b n"], translation: Float[Tensor, "*b 3"] | None = None
    ) -> BodyPose:
        """From SMPL's pose vector of n = 72 numbers: 24 axis-angle vectors in radians, the pelvis first.

        Raises:
            ValueError: theta does not end in 72 values.
        """
        if theta.shape[-1] != 3 * J:
            raise ValueError(
                f"A pose is {3 * J} numbers (24 joints x axis-angle) but theta has shape {tuple(theta.shape)}; "
                "drop the hand joints of SMPL-H or SMPL-X, or prepend the pelvis rotation to a 69-number body pose."
            )
        if translation is None:
            translation = theta.new_zeros(*theta.shape[:-1], 3)
        return cls(axis_angle_to_matrix(theta.unflatten(-1, (J, 3))), translation)


@dataclasses.dataclass(frozen=True)
class BodyModel(TensorRecord):
    """A body model without shape or pose; metres, y up, facing +z, left side at +x."""

    template: Float[Tensor, "V 3"]
    """The mean body in the rest pose."""
    shape_basis: Float[Tensor, "V 3 B"]
    """Vertex offsets per unit of each shape coefficient, metres."""
    pose_basis: Float[Tensor, "V 3 P"]
    """Vertex offsets per entry of (R - I) of the 23 joints below the pelvis, row-major; P may be 0."""
    joint_regressor: Float[Tensor, "J V"]
    """Joints as weighted sums of the shaped vertices."""
    skin_weights: Float[Tensor, "V J"]
    """Skinning weights of the joints; rows sum to 1."""
    parents: Int[Tensor, "J"]
    """Each joint's parent, -1 for the root; a parent comes before its children."""
    faces: Int[Tensor, "F 3"]
    """Counter-clockwise seen from outside."""
    uv: Float[Tensor, "T 2"]
    """Texture coordinates in [0, 1], v up as in OBJ files."""
    uv_faces: Int[Tensor, "F 3"]
    """Indices into `uv` of each face's corners."""

    def shape(self, betas: Float[Tensor, "*b N"]) -> ShapedBody:
        """Apply shape coefficients (SMPL eqs. 8 and 10). Fewer betas than the basis has are padded with zeros.

        Raises:
            ValueError: there are more betas than the basis has components.
        """
        count, available = betas.shape[-1], self.shape_basis.shape[-1]
        if count > available:
            raise ValueError(
                f"{count} betas were given but this body has {available} shape components; drop the last ones."
            )
        offsets = torch.einsum("vcn,...n->...vc", self.shape_basis[..., :count], betas)
        vertices = self.template + offsets
        return ShapedBody(self, vertices, self.joint_regressor @ vertices)


@dataclasses.dataclass(frozen=True)
class ShapedBody(TensorRecord):
    """A body with shape, in the rest pose."""

    model: BodyModel
    vertices: Float[Tensor, "*b V 3"]
    """Metres."""
    joints: Float[Tensor, "*b J 3"]
    """Metres."""

    def pose(self, pose: BodyPose) -> PosedBody:
        """Pose the body (SMPL eqs. 2-4, 7 and 9); batches of bodies and poses broadcast."""
        joints = self.joints
        world_from_joint = world_from_joints(pose.joint_rotation, joints, self.model.parents.tolist())
        identity = torch.eye(3, dtype=joints.dtype, device=joints.device)
        world_from_joint = rigid_matrix(identity, pose.translation)[..., None, :, :] @ world_from_joint
        skinning = world_from_rest(world_from_joint, joints)
        vertices = skin(self._corrected(pose.joint_rotation), self.model.skin_weights, skinning)
        return PosedBody(vertices, world_from_joint, skinning)

    def follow(self, skinning: Float[Tensor, "*#b J r 4"]) -> Float[Tensor, "... V 3"]:
        """Skin the vertices with 24 arbitrary affine matrices (r = 3 or 4 rows), such as those of an armature.

        `skinning` maps rest points to posed points, as `PosedBody.skinning` does. The pose-dependent correctives (SMPL
        eq. 9) use the joints' rotations relative to their parents, without scale and shear.
        """
        if self.model.pose_basis.numel() == 0:
            return skin(self.vertices, self.model.skin_weights, skinning)
        relative = relative_rotations(skinning, self.model.parents.tolist())
        return skin(self._corrected(relative), self.model.skin_weights, skinning)

    def _corrected(self, joint_rotation: Float[Tensor, "*#b J 3 3"]) -> Float[Tensor, "... V 3"]:
        """Rest vertices with the pose-dependent correctives of SMPL eq. 9."""
        if self.model.pose_basis.numel() == 0:
            return self.vertices
        identity = torch.eye(3, dtype=joint_rotation.dtype, device=joint_rotation.device)
        feature = (joint_rotation[..., 1:, :, :] - identity).flatten(-3)
        return self.vertices + torch.einsum("vcp,...p->...vc", self.model.pose_basis, feature)


@dataclasses.dataclass(frozen=True)
class PosedBody(TensorRecord):
    """A posed body in world space."""

    vertices: Float[Tensor, "*b V 3"]
    """Metres."""
    joints: Float[Tensor, "*b J 4 4"]
    """World from joint: orientation and position of every joint."""
    skinning: Float[Tensor, "*b J 4 4"]
    """World from rest: the transform of each joint for points of the rest pose."""


@functools.cache
def default_body() -> BodyModel:
    """The body that ships with the package: float32, 12,196 vertices, 10 shape components, no pose blend shapes."""
    names = ("v_template", "shapedirs", "J_regressor", "weights", "vt", "f", "ft", "kintree_table")
    with importlib.resources.as_file(importlib.resources.files("primdiffusion.body") / "data/body.npz") as path:
        arrays = read_arrays(path, names)
    parents = arrays["kintree_table"][0].astype(np.int64)
    parents[0] = -1
    return BodyModel(
        template=torch.from_numpy(arrays["v_template"]),
        shape_basis=torch.from_numpy(arrays["shapedirs"]),
        pose_basis=torch.zeros(len(arrays["v_template"]), 3, 0),
        joint_regressor=torch.from_numpy(arrays["J_regressor"]),
        skin_weights=torch.from_numpy(arrays["weights"]),
        parents=torch.from_numpy(parents),
        faces=torch.from_numpy(arrays["f"].astype(np.int64)),
        uv=torch.from_numpy(arrays["vt"]),
        uv_faces=torch.from_numpy(arrays["ft"].astype(np.int64)),
    )


def read_motion(path: str | Path, person: str = "") -> BodyPose:
    """Read all frames of a file (`formats.poses.files`): rotations [F, 24, 3, 3], translations [F, 3] in metres, y up.

    `person` is one of several people in it; by default who is in the most frames.
    Raises FileNotFoundError or FileError.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"the pose file {path} does not exist: check the path")
    return _as_pose(files.read_motion(path, person=person))


def read_pose(path: str | Path, frame: int = 0, person: str = "") -> BodyPose:
    """Read a `frame` of a file as `read_motion`, or its only pose.

        >>> pose = pd.read_pose("walk.npz", frame=5)
        >>> pose.joint_rotation.shape
        torch.Size([24, 3, 3])

    Raises FileNotFoundError and ValueError.
    """
    return _frame(read_motion(path, person), str(path), frame)


def _as_pose(motion: Motion) -> BodyPose:
    return BodyPose(*(torch.from_numpy(a.astype(np.float32)) for a in (motion.rotations, motion.translations)))


def _frame(poses: BodyPose, name: str, frame: int) -> BodyPose:
    frames = len(poses.translation)
    if frames > 1 and not 0 <= frame < frames:
        raise ValueError(f"{name} has {frames} frames, counted from 0: there is no frame {frame}, choose another")
    return poses.map(lambda values: values[frame if frames > 1 else 0])
