"""Any rig as a chain of bones in numpy, posed by SMPL's joint rotations as Blender will pose it."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES, PARENTS
from ..motion.skeleton import chain


@dataclasses.dataclass(frozen=True, eq=False)
class Skeleton:
    """A rig at rest in the world; metres, y up, facing +z."""

    names: list[str]
    """Of the bones, parents first [N]."""
    parents: list[int]
    """Of each bone, -1 for a root."""
    heads: NDArray[np.float64]
    """[N, 3]."""
    axes: NDArray[np.float64]
    """World from the bone's own axes, rotations [N, 3, 3]."""
    joint: NDArray[np.int64]
    """The SMPL joint that each bone is [N]; -1 for fingers, twists and the like, which stay with their parents."""
    at_rest: NDArray[np.float64]
    """How each part is turned from SMPL's rest to the rig's [24, 3, 3] (`motion.rigs`)."""
    body_joints: NDArray[np.float64]
    """The fitted body's joints at SMPL's rest [24, 3]: the whole turns about its pelvis."""

    def transforms(self, rotations: NDArray, translation: NDArray) -> NDArray[np.float64]:
        """What each bone does to points of the rig's rest [N, 4, 4] in a pose of SMPL's joints.

        A bone that is joint j turns by G_j A_j^T: back from the rig's rest to SMPL's, then as SMPL's joint in the
        world. Its head goes where its parent takes it; bones without a posed parent go where the body's pelvis does.
        """
        world = chain(np.asarray(rotations, np.float64))
        moves = world @ np.swapaxes(self.at_rest, -1, -2)
        out = np.tile(np.eye(4), (len(self.names), 1, 1))
        pelvis = self.body_joints[0]
        for bone, parent in enumerate(self.parents):
            joint = self.joint[bone]
            if parent >= 0:
                out[bone] = out[parent]
            if joint < 0:
                continue
            out[bone, :3, :3] = moves[joint]
            if self.is_top(bone):
                head = pelvis + world[0] @ (self.heads[bone] - pelvis) + translation
            else:
                head = out[parent, :3, :3] @ self.heads[bone] + out[parent, :3, 3]
            out[bone, :3, 3] = head - moves[joint] @ self.heads[bone]
        return out

    def is_top(self, bone: int) -> bool:
        """Whether a bone is a joint and none above it is."""
        if self.joint[bone] < 0:
            return False
        above = self.parents[bone]
        while above >= 0:
            if self.joint[above] >= 0:
                return False
            above = self.parents[above]
        return True

    def joints(self, transforms: NDArray) -> NDArray[np.float64]:
        """The 24 joints [24, 3]: the bones' heads, and for joints that the rig lacks the body's, off their parents."""
        bone_of = {int(joint): bone for bone, joint in enumerate(self.joint) if joint >= 0}
        places = np.zeros((len(JOINT_NAMES), 3))
        carrier = list(range(len(JOINT_NAMES)))
        for joint, parent in enumerate(PARENTS):
            bone = bone_of.get(joint)
            if bone is not None:
                places[joint] = transforms[bone, :3, :3] @ self.heads[bone] + transforms[bone, :3, 3]
                continue
            carrier[joint] = carrier[parent]
            turn = transforms[bone_of[carrier[joint]], :3, :3] @ self.at_rest[carrier[joint]]
            places[joint] = places[parent] + turn @ (self.body_joints[joint] - self.body_joints[parent])
        return places

    def bases(self, transforms: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Turns [N, 3, 3] of the pose bones in their own axes, and displacements [N, 3] of the tops, metres."""
        identity = np.eye(4)
        above = np.array([transforms[p] if p >= 0 else identity for p in self.parents])
        inverse = np.swapaxes(above[:, :3, :3], -1, -2)
        own = np.swapaxes(self.axes, -1, -2)
        turns = own @ inverse @ transforms[:, :3, :3] @ self.axes
        here = (transforms[:, :3, :3] @ self.heads[..., None])[..., 0] + transforms[:, :3, 3]
        carried = (above[:, :3, :3] @ self.heads[..., None])[..., 0] + above[:, :3, 3]
        moves = (own @ inverse @ (here - carried)[..., None])[..., 0]
        tops = np.array([self.is_top(bone) for bone in range(len(self.names))])
        return turns, np.where(tops[:, None], moves, 0.0)
