"""Contact sheets of captures with skeletons drawn on them, to check images, cameras and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw

from primdiffusion.body.model import BodyModel, BodyPose, J, default_body
from primdiffusion.capture.reader import Captures, Subject
from primdiffusion.files.arrays import read_numbers
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.whole_files import replacing
from primdiffusion.formats.camera_rig import View

BONE, JOINT = (255, 255, 255), (255, 64, 64)


def draw_sheet(captures: Captures, out: Path, rows: int, columns: int, size: int) -> None:
    """Write the sheet, one subject in one pose per row.

    Rows cycle through the poses; every other image has the joints drawn on it.

    Raises:
        ValueError: a size is not positive.
        FileNotFoundError, FileError: a file is missing or damaged.
    """
    if min(rows, columns, size) < 1:
        raise ValueError(f"rows, columns and size are {rows}, {columns} and {size}: give 1 or more")
    lines = []
    for name, frame in _chosen(captures, rows):
        subject = captures.subject(name)
        joints = joints_of(subject)[frame]
        cameras = _evenly(len(subject.views), columns)
        lines.append([_thumbnail(subject, frame, camera, size) for camera in cameras])
        for camera, picture in list(zip(cameras, lines[-1], strict=True))[1::2]:
            _draw_joints(picture, subject.views[camera], joints)
    widths = max(sum(picture.width for picture in line) for line in lines)
    sheet = Image.new("RGB", (widths, size * len(lines)))
    for row, line in enumerate(lines):
        left = 0
        for picture in line:
            sheet.paste(picture, (left, size * row))
            left += picture.width
    with replacing(out) as path:
        sheet.save(path, format="PNG")


def joints_of(subject: Subject, body: BodyModel | None = None) -> Float[np.ndarray, "F J 3"]:
    """World positions of the joints from joints.npz; without it (released layout), those of the body (None: default).

    Raises:
        FileError: joints.npz is damaged, or of other frames or joints.
    """
    stored = _stored_joints(subject)
    return body_joints(subject, default_body() if body is None else body) if stored is None else stored["world"]


def joints_from_body(subject: Subject, body: BodyModel) -> Float[np.ndarray, "F J 3"]:
    """World positions [F, J, 3] of a body's joints from joints.npz minus those stored of the body with its betas.

    They are zero for the body whose betas are stored, whatever rig the subject has. Raises as `joints_of`.
    """
    stored, own = _stored_joints(subject), body_joints(subject, body)
    return np.zeros_like(own) if stored is None else own - stored.get("fitted", stored["world"])


def _stored_joints(subject: Subject) -> dict[str, np.ndarray] | None:
    path = subject.folder / "joints.npz"
    try:
        stored = read_numbers(path, ("world",), optional=("fitted",))
    except FileNotFoundError:
        return None
    for joints in stored.values():
        if joints.shape != (subject.frames, J, 3):
            raise FileError(path, f"has joints of shape {joints.shape} for {subject.frames} frames", "render again")
    return stored


def body_joints(subject: Subject, body: BodyModel) -> Float[np.ndarray, "F J 3"]:
    """World positions of a body's joints in the subject's shape and poses."""
    smpl = subject.smpl
    pose = BodyPose.from_axis_angle(torch.from_numpy(smpl.theta), torch.from_numpy(smpl.translation))
    return body.shape(torch.from_numpy(smpl.betas)).pose(pose).joints[..., :3, 3].double().numpy()


def _chosen(captures: Captures, rows: int) -> list[tuple[str, int]]:
    """Subjects and frames for the rows: as many subjects as possible, each in the next pose."""
    names = [captures.subjects[i] for i in _evenly(len(captures.subjects), rows)]
    frames = {name: captures.subject(name).frames for name in names}
    turns = [
        (name, (turn + place) % frames[name])
        for turn in range(max(frames.values()))
        for place, name in enumerate(names)
        if turn < frames[name]
    ]
    return sorted(turns[:rows])


def _thumbnail(subject: Subject, frame: int, camera: int, size: int) -> Image.Image:
    picture = Image.fromarray(subject.picture("img", frame, camera))
    width = max(1, round(picture.width * size / picture.height))
    return picture.resize((width, size), Image.Resampling.BOX)


def _draw_joints(picture: Image.Image, view: View, joints: Float[np.ndarray, "J 3"]) -> None:
    pixels, depth = view.project(joints)
    scale = picture.height / view.height
    draw = ImageDraw.Draw(picture)
    places = [tuple(pixel * scale) for pixel in pixels]
    for joint, parent in enumerate(default_body().parents.tolist()):
        if parent >= 0 and min(depth[joint], depth[parent]) > 0:
            draw.line([places[parent], places[joint]], fill=BONE)
    radius = max(picture.height / 160, 1)
    for (x, y), z in zip(places, depth, strict=True):
        if z > 0:
            draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=JOINT)


def _evenly(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` indices, evenly spaced, including the first."""
    return sorted({int(i * count / min(wanted, count)) for i in range(min(wanted, count))})
