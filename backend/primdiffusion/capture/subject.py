"""One person's views drawn by the rasteriser and written in the layout of captures."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.people_files import SkinnedPerson
from primdiffusion.formats import camera_files, capture_layout, picture_files
from primdiffusion.formats.arrays import ArrayFileError, read_numbers
from primdiffusion.formats.camera_rig import Rig, View, bounding_sphere
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.raster.multisample import Figure, Shot, figure_of, shoot
from primdiffusion.raster.textures import BYTE_OF_LINEAR, encode_bytes

JPEG_QUALITY = 95


@dataclasses.dataclass(frozen=True, eq=False)
class Sitting:
    """A person, the poses to take and the cameras about them."""

    figure: Figure
    betas: Float[np.ndarray, "n"]
    poses: BodyPose
    """Of F frames."""
    skinning: Float[np.ndarray, "F J 4 4"]
    """World from rest."""
    joints: Float[np.ndarray, "F J 3"]
    """World, metres."""
    views: list[View]


def sit(person: SkinnedPerson, poses: BodyPose, rig: Rig | Sequence[View]) -> Sitting:
    """The person in all `poses` [F], the cameras of a rig as far away as shows all of them whole, or given ones.

    Raises:
        UnusableMesh: the mesh cannot be drawn.
        ValueError: the poses are not finite.
    """
    figure = figure_of(person.mesh)
    with _one_thread():
        shaped = default_body().to(dtype=torch.float64).shape(torch.from_numpy(person.betas).double())
        body = shaped.pose(poses.to(dtype=torch.float64))
    skinning, joints = body.skinning.numpy(), body.joints[..., :3, 3].numpy()
    if isinstance(rig, Rig):
        moved = [part.posed(matrices).vertices for matrices in skinning for part in person.mesh.parts]
        views = rig.views(*bounding_sphere(np.concatenate(moved)))
    else:
        views = list(rig)
    return Sitting(figure, person.betas, poses, skinning, joints, views)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Sums in one order, so that any number of workers writes the same files to the last digit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def begin(subject: Path, sitting: Sitting) -> None:
    """Write all but the pictures.

    Raises:
        CaptureFolderError: the folder holds pictures of other poses or another shape.
        OSError: it cannot be written to.
    """
    theta = matrix_to_axis_angle(sitting.poses.joint_rotation).numpy().reshape(len(sitting.skinning), -1)
    translation = sitting.poses.translation.numpy()
    _refuse_others(subject, theta, sitting.betas, translation)
    capture_layout.write_smpl(subject, theta[:, :3], theta[:, 3:], sitting.betas, translation)
    capture_layout.write_joints(subject, sitting.views, sitting.joints)
    camera_files.write_cameras(subject, sitting.views)
    camera_files.write_opencv(subject, sitting.views)
    for frame in range(len(theta)):
        camera_files.write_nerf(subject, sitting.views, frame)
        camera_files.write_colmap(subject, sitting.views, frame)


def draw_frames(
    subject: Path, sitting: Sitting, frames: Iterable[int], passes: Sequence[str], samples: int
) -> Iterator[tuple[int, int]]:
    """Draw the views of `frames` that are not there yet; yields frame and camera of each, drawn or found.

    Raises:
        OSError: a picture cannot be written.
    """
    for frame in frames:
        posed = None
        for camera, view in enumerate(sitting.views):
            if not is_drawn(subject, passes, camera, frame):
                posed = sitting.figure.posed(sitting.skinning[frame]) if posed is None else posed
                write_shot(subject, passes, camera, frame, shoot(posed, view, samples))
            yield frame, camera


def last_pass(passes: Sequence[str]) -> str:
    """The pass whose picture is written last: the view is done when it is whole."""
    return "img" if "img" in passes else passes[-1]


def is_drawn(subject: Path, passes: Sequence[str], camera: int, frame: int) -> bool:
    """Whether all pictures of a view are there and whole."""
    return all(
        picture_files.is_whole_picture(capture_layout.picture_path(subject, kind, camera, frame)) for kind in passes
    )


def write_shot(subject: Path, passes: Sequence[str], camera: int, frame: int, shot: Shot) -> None:
    """The pictures of one view, each written whole, the one that marks the view as done last."""
    for kind in sorted(passes, key=lambda kind: kind == last_pass(passes)):
        path = capture_layout.picture_path(subject, kind, camera, frame)
        if kind == "img":
            with capture_layout.replacing(path) as partial:
                Image.fromarray(srgb_bytes(shot.rgb)).save(partial, quality=JPEG_QUALITY, subsampling=0)
        elif kind == "mask":
            picture_files.write_png(path, np.round(shot.coverage.clip(0, 1) * 255).astype(np.uint8))
        elif kind == "depth":
            picture_files.write_png(path, picture_files.depth_steps(shot.depth))
        elif kind == "normal":
            picture_files.write_png(path, picture_files.normal_bytes(shot.normal, shot.depth > 0))
        else:
            picture_files.write_png(path, shot.part)


def srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """Linear colours as sRGB-encoded bytes."""
    encoded = np.empty(linear.shape, np.uint8)
    encode_bytes(np.ascontiguousarray(linear, np.float32).ravel(), BYTE_OF_LINEAR, encoded.ravel())
    return encoded


def _refuse_others(subject: Path, theta: np.ndarray, betas: np.ndarray, translation: np.ndarray) -> None:
    path = subject / capture_layout.SMPL_FOLDER / capture_layout.SMPL_PLAIN_FILE
    wanted = {"global_orient": theta[:, :3], "body_pose": theta[:, 3:], "betas": betas[None], "transl": translation}
    try:
        present = read_numbers(path, tuple(wanted))
    except (FileNotFoundError, ArrayFileError):
        return  # nothing yet, or cut short: it is written anew
    for name, values in wanted.items():
        if present[name].shape != values.shape or not np.allclose(present[name], values, atol=1e-5):
            raise capture_layout.CaptureFolderError(
                f"{subject} holds another person or other poses ({name} differ): choose another folder, or remove it"
            )
