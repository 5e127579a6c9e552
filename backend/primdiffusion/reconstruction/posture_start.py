"""Where a posture starts from: a pose file or a standing body, and cameras of a file or framed by the masks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.photograph import Photograph
from primdiffusion.capture.reader import as_camera, windowed_view
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera
from primdiffusion.human import pose_body
from primdiffusion.reconstruction.posture_fit import Posture, each

STANDING_ARMS = (0.0, 30.0, 55.0, 75.0)
"""Degrees by which the arms of a standing body may be lowered from the T pose."""
FRAMING_STEPS = 4
"""Distance and place are found together, because near parts look larger."""
NEAREST, FARTHEST = 1.0, 1e3
"""Metres between a camera and a body."""


def cameras_of(photographs: Sequence[Photograph], views: Sequence[View]) -> Camera:
    """Cameras of the squares that are kept of pictures, from those of the whole pictures."""
    side = len(photographs[0].rgba)
    return stack([as_camera(windowed_view(view, p.window, side)) for view, p in zip(views, photographs, strict=True)])


def views_of(photographs: Sequence[Photograph], camera: Camera) -> list[View]:
    """The inverse: cameras of whole pictures."""
    views = []
    for photograph, one in zip(photographs, each(camera), strict=True):
        window, intrinsics = photograph.window, one.intrinsics.double().clone()
        intrinsics[0] *= window.width / one.width
        intrinsics[1] *= window.height / one.height
        intrinsics[0, 2] += window.left
        intrinsics[1, 2] += window.top
        extrinsics = one.world_to_camera.double()
        views.append(
            View(
                intrinsics.numpy(),
                extrinsics[:, :3].numpy(),
                extrinsics[:, 3].numpy(),
                photograph.width,
                photograph.height,
            )
        )
    return views


def framed(
    photographs: Sequence[Photograph], pose: BodyPose, betas: Float[Tensor, "n"], lenses: Sequence[View]
) -> Camera:
    """Cameras of the kept squares, level and facing the front (+z) of the world, that see bodies as large as figures.

    `lenses` are cameras of the whole pictures whose positions do not count.
    """
    return stack([
        _framed(photograph, one, betas, lens)
        for photograph, one, lens in zip(photographs, each(pose), lenses, strict=True)
    ])  # fmt: skip


def _framed(photograph: Photograph, pose: BodyPose, betas: Float[Tensor, "n"], lens: View) -> Camera:
    side = len(photograph.rgba)
    camera = as_camera(windowed_view(lens, photograph.window, side))
    mask = torch.from_numpy(photograph.rgba[..., 3] > 127)
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    low = torch.stack([columns[0], rows[0]]).float()
    high = torch.stack([columns[-1], rows[-1]]).float() + 1
    points = pose_body(betas, pose).vertices
    rotation, focal = camera.world_to_camera[:, :3], camera.intrinsics[0, 0]
    middle = rotation @ (points.amin(0) + points.amax(0)) / 2
    tall = float(points[:, 1].amax() - points[:, 1].amin())
    place = torch.tensor([0.0, 0.0, min(float(focal) * tall / float(high[1] - low[1]), FARTHEST)])
    for _ in range(FRAMING_STEPS):
        seen = _at(camera, place - middle).project(points)[0]
        off = (low + high - seen.amin(0) - seen.amax(0)) / 2
        place = place + torch.cat([off * place[2] / focal, torch.zeros(1)])
        place = place * (seen[:, 1].amax() - seen[:, 1].amin()) / (high[1] - low[1])
        place[2] = place[2].clamp(NEAREST, FARTHEST)
    return _at(camera, place - middle)


def _at(camera: Camera, translation: Float[Tensor, "3"]) -> Camera:
    return dataclasses.replace(
        camera, world_to_camera=torch.cat([camera.world_to_camera[:, :3], translation[:, None]], 1)
    )


def standing(count: int, arms: float) -> BodyPose:
    """Upright bodies [count] that face +z, with arms lowered by `arms` degrees from the T pose."""
    theta = torch.zeros(count, len(JOINT_NAMES), 3)
    theta[:, JOINT_NAMES.index("left_shoulder"), 2] = -math.radians(arms)
    theta[:, JOINT_NAMES.index("right_shoulder"), 2] = math.radians(arms)
    return BodyPose.from_axis_angle(theta.flatten(1))


def turned_to_camera(pose: BodyPose) -> BodyPose:
    """Poses in a camera's axes (y down, facing -z), as estimators give them, in ours; others stay as they are."""
    if float(pose.joint_rotation[:, 0, 1, 1].mean()) >= 0:
        return pose
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    rotation = torch.cat([(turn @ pose.joint_rotation[:, 0])[:, None], pose.joint_rotation[:, 1:]], 1)
    return BodyPose(rotation, torch.zeros_like(pose.translation))


def before_cameras(posture: Posture, camera: Camera) -> Posture:
    """The same humans, standing before other cameras as they stand before their own."""
    own, other = posture.camera.world_to_camera, camera.world_to_camera
    turn = other[:, :, :3].mT @ own[:, :, :3]
    rotation = posture.pose.joint_rotation
    rotation = torch.cat([(turn @ rotation[:, 0])[:, None], rotation[:, 1:]], 1)
    pelvis = default_body().shape(posture.betas).joints[0]
    place = (own[:, :, :3] @ (pelvis + posture.pose.translation)[:, :, None])[..., 0] + own[:, :, 3]
    place = (other[:, :, :3].mT @ (place - other[:, :, 3])[:, :, None])[..., 0]
    return Posture(BodyPose(rotation, place - pelvis), posture.betas, camera)


def repeated(pose: BodyPose, count: int) -> BodyPose:
    """The one pose for all pictures, or the one pose of each. Raises ValueError for another number of poses."""
    poses = len(pose.translation)
    if poses not in (1, count):
        raise ValueError(f"the pose file has {poses} poses for {count} pictures: give a pose for each, or one for all")
    return pose.map(lambda values: values.expand(count, *values.shape[1:]))
