"""The start of a posture: a pose file or a standing body, and cameras of a file or framed by the masks.

A posture that was found is written to a file from which another fit can start.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import LARGEST_BETA, BodyPose, default_body, read_motion
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.photograph import Photograph
from primdiffusion.capture.reader import as_camera, windowed_view
from primdiffusion.diffusion.model import BETAS
from primdiffusion.files.json_files import read_json
from primdiffusion.files.regular_files import FileError, as_file_error
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.capture_layout import views_in
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.human import pose_body
from primdiffusion.reconstruction.posture_fit import Posture, each

_RAISED = ((75.0, -60.0), (-60.0, 75.0))
_ACROSS = (*((arms, arms) for arms in (0.0, 30.0, 55.0, 75.0)), (55.0, 55.0, 0.0, 96.0), *_RAISED)
_ALONG = (*((75.0, 75.0, stride) for stride in (-35.0, -20.0, 0.0, 20.0, 35.0)), (20.0, 20.0))
STANCES: Sequence[tuple[float, Sequence[tuple[float, ...]]]] = (
    (0, _ACROSS), (180, _ACROSS),
    *((side, stances) for side in (90, 270) for stances in (_ALONG, *((raised,) for raised in _RAISED))),
)  # fmt: skip
"""Stances of a standing body: degrees that it is turned to its left, and arguments of `standing`, of which the best
are tried. From the side, outlines do not tell which arm is raised."""
TWIST = 0.4
"""Twist of an upper arm, by the angle of its elbow, where a hand is at the hip."""
FRAMING_STEPS = 4
"""Distance and place are found together, because near parts look larger."""
NEAREST, FARTHEST = 1.0, 1e3
"""Metres between a camera and a body."""


def cameras_of(photographs: Sequence[Photograph], views: Sequence[View]) -> Camera:
    """Cameras of the squares that are kept of pictures, from those of the whole pictures."""
    side = len(photographs[0].rgba)
    return stack([as_camera(windowed_view(view, p.window, side)) for view, p in zip(views, photographs, strict=True)])


def views_of(photographs: Sequence[Photograph], camera: Camera) -> list[View]:
    """Cameras of whole pictures: the inverse of `cameras_of`."""
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


def standing(
    left_arm: float, right_arm: float, stride: float = 0.0, bent: float = 0.0, *, turned: float = 0.0
) -> BodyPose:
    """An upright body [1] that faces +z, turned by so many degrees to its left.

    Arms are lowered by degrees from the T pose, and bent by degrees that bring hands to the hips; the left leg is
    lifted forward by `stride` degrees, the right one back.
    """
    theta = torch.zeros(1, len(JOINT_NAMES), 3)
    for joint, axis, degrees in (
        ("pelvis", 1, turned), ("left_shoulder", 2, -left_arm), ("right_shoulder", 2, right_arm),
        ("left_shoulder", 0, TWIST * bent), ("right_shoulder", 0, TWIST * bent),
        ("left_elbow", 1, -bent), ("right_elbow", 1, bent),
        ("left_hip", 0, -stride), ("right_hip", 0, stride),
    ):  # fmt: skip
        theta[0, JOINT_NAMES.index(joint), axis] = math.radians(degrees)
    return BodyPose.from_axis_angle(theta.flatten(1))


def turned_to_camera(pose: BodyPose) -> BodyPose:
    """Poses in a camera's axes (y down, facing -z), as estimators give them, in ours; others stay as they are."""
    if float(pose.joint_rotation[:, 0, 1, 1].mean()) >= 0:
        return pose
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    rotation = torch.cat([(turn @ pose.joint_rotation[:, 0])[:, None], pose.joint_rotation[:, 1:]], 1)
    return BodyPose(rotation, torch.zeros_like(pose.translation))


def place_in_camera(posture: Posture, camera: Camera) -> Posture:
    """Move humans before other cameras, where they stand as before their own."""
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


FORMAT = "primdiffusion-posture"


@dataclasses.dataclass(frozen=True, eq=False)
class PostureFile:
    """Content of a pose file; only our own hold more than poses."""

    pose: BodyPose
    """[n]."""
    betas: Float[Tensor, "10"] | None = None
    views: list[View] | None = None
    """Cameras of the whole pictures."""


def read_posture(path: Path, sizes: Sequence[tuple[int, int]]) -> PostureFile:
    """Read a pose file (`primdiffusion.body.model`) or a posture of pictures of `sizes` (width, height).

    Raises FileNotFoundError, and ValueError for what is not a pose or of another rig; the message names the file.
    """
    pose = read_motion(path)
    content = read_json(path) if path.suffix.lower() == ".json" else None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        return PostureFile(pose)
    with as_file_error(path, "has no betas", "fit the pose again"):
        betas = torch.from_numpy(np.asarray(content["betas"], np.float32))
    if betas.shape != (BETAS,) or not (betas.abs() <= LARGEST_BETA).all():
        raise FileError(path, f"has other betas than {BETAS} up to {LARGEST_BETA:g}", "fit the pose again")
    return PostureFile(pose, betas, _views(content.get("cameras"), path, sizes))


def read_cameras(path: Path, sizes: Sequence[tuple[int, int]]) -> list[View]:
    """Read a cameras.json, or the cameras of a posture, one for each picture of `sizes`.

    Raises FileNotFoundError and FileError.
    """
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no file of cameras {path}: check the path") from None
    except (OSError, ValueError) as e:
        raise FileError(path, f"cannot be read ({e!s:.120})", "give a cameras.json") from e
    return _views(content.get("cameras", content) if isinstance(content, dict) else content, path, sizes)


def write_posture(
    path: Path,
    pose: BodyPose,
    betas: Float[Tensor, "10"],
    views: Sequence[View],
    fit: Mapping[str, Any] | None = None,
) -> None:
    """Write a posture, and how well it explains its pictures, whole or not at all. Raises OSError."""
    theta = matrix_to_axis_angle(pose.joint_rotation).flatten(1)
    content = {
        "format": FORMAT,
        **({} if fit is None else {"fit": dict(fit)}),
        "pose": _rounded(theta),
        "translation": _rounded(pose.translation),
        "betas": _rounded(betas),
        "cameras": {
            f"camera{number:04d}": {
                "K": view.intrinsics.tolist(),
                "R": view.rotation.tolist(),
                "T": view.translation.tolist(),
            }
            for number, view in enumerate(views)
        },
    }
    write_atomically(path, json.dumps(content))


def _rounded(values: Tensor) -> Any:
    return values.double().numpy().round(6).tolist()


def _views(named: Any, path: Path, sizes: Sequence[tuple[int, int]]) -> list[View]:
    size: Callable[[int], tuple[int, int]] = sizes.__getitem__
    if not isinstance(named, dict) or len(named) != len(sizes):
        count = len(named) if isinstance(named, dict) else "no"
        raise FileError(path, f"has {count} cameras for {len(sizes)} pictures", "give one for each")
    views = views_in(named, path, size)
    for number, view in enumerate(views):
        if min(view.intrinsics[0, 0], view.intrinsics[1, 1]) < 1:
            raise FileError(path, f"has no camera in camera{number:04d}", "K has focal lengths in pixels")
    return views
