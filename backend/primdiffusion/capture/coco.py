"""Annotations of finished captures in COCO's format, for trainers of keypoints and masks.

    root/annotations.json    images, persons with boxes, run-length masks and COCO's 17 keypoints; cameras, SMPL and
                             attributes too
    root/composed/           images of humans who stand together

Each human is captured alone; annotations put those who stand together into one image, so that one who is partly hidden
has a whole mask too.

All follow from the files of the captures alone, so that the same captures give the same bytes.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from PIL import Image
from torch import Tensor

from primdiffusion.body.model import BodyModel, BodyPose, J, default_body
from primdiffusion.capture.reader import Captures, Subject, joints_from_body, joints_of
from primdiffusion.capture.render import JPEG_QUALITY, srgb_bytes
from primdiffusion.files.picture_files import DEPTH_UNIT
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.whole_files import atomic_replace
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import MOST_TOGETHER, View
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.raster.textures import LINEAR_OF_BYTE

ANNOTATIONS_FILE = "annotations.json"
PASSES = ("img", "mask", "depth")
"""Passes that annotations need."""
THRESHOLD = 128
"""Masks are the pixels with at least this coverage, of 255: half the pixel."""
FACE = {"nose": (4526, 4526), "left_eye": (6201, 6246), "right_eye": (21, 66), "left_ear": (10882, 10882),
        "right_ear": (4863, 4863)}  # fmt: skip
"""COCO's keypoints that SMPL has no joints for, each the mean of two of the default body's vertices: tip of the nose,
corners of the eyelids, outermost points of the ears."""
THICKNESS = {"nose": 0.04, "eye": 0.04, "ear": 0.04, "shoulder": 0.16, "elbow": 0.12, "wrist": 0.1, "hip": 0.22,
             "knee": 0.16, "ankle": 0.16}  # fmt: skip
"""Metres: a keypoint deeper behind the nearest surface is hidden. More than from the joint to the surface around the
limb, in wide clothes, and less than to the far side of a limb in front of it, or from one hip across to the other."""
JOINTS = tuple(
    f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
)
"""The joints that SMPL and COCO share, in COCO's order."""
KEYPOINTS = (*FACE, *JOINTS)
"""COCO's 17 keypoints in their order."""
SKELETON = (
    (16, 14), (14, 12), (17, 15), (15, 13), (12, 13), (6, 12), (7, 13), (6, 7), (6, 8), (7, 9), (8, 10), (9, 11),
    (2, 3), (1, 2), (1, 3), (2, 4), (3, 5), (4, 6), (5, 7),
)  # fmt: skip
"""COCO's limbs between keypoints, which are counted from 1."""
CATEGORY = {"id": 1, "name": "person", "supercategory": "person", "keypoints": KEYPOINTS, "skeleton": SKELETON}
SAME_BODY = 0.002
"""Metres between the joints of the captures' body and the default body's up to which it is the default body."""
_HEAD = JOINT_NAMES.index("head")
_JOINTS = [JOINT_NAMES.index(name) for name in JOINTS]
_HIPS = [KEYPOINTS.index("left_hip"), KEYPOINTS.index("right_hip")]
_THICKNESS = np.array([THICKNESS[name.rpartition("_")[2]] for name in KEYPOINTS])
_FARTHEST = DEPTH_UNIT * np.iinfo(np.uint16).max


def write_coco(
    captures: Captures,
    attributes: Mapping[str, Mapping[str, Any]],
    report: Callable[[str], object] = lambda subject: None,
) -> None:
    """Write annotations.json into the captures' folder; it appears at the end or not at all.

    Of humans who stand together (`groups`), composed images are written, which are annotated.

    Keypoints are indices of pixels as COCO's: the centre of the upper left pixel is (0, 0). Their visibility is COCO's:
    0 outside of the image or unknown, 1 hidden, 2 visible. The face's are known where the subject has the default body.
    An image without a pixel of its subject has no annotation.

    Args:
        captures: images, masks and depth of finished subjects.
        attributes: values by subject and name; a subject may lack all or some.
        report: called with the name of each annotated subject.

    Raises:
        FileNotFoundError, FileError: a pass or file is missing, or damaged.
        FileError, OSError: a file cannot be written, or lies behind a link out of the captures.
    """
    if missing := [kind for kind in PASSES if kind not in captures.passes]:
        raise FileError(captures.root, f"has no {' and no '.join(missing)}", f"render with {', '.join(PASSES)}")
    with (
        atomic_replace(captures.root / ANNOTATIONS_FILE) as path,
        path.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write('{"info":{"description":"PrimDiffusion captures"},"licenses":[],')
        file.write(f'"categories":[{_line(CATEGORY)}],\n"images":[\n')
        file.writelines(_separated(_line(image.record) for image in _images(captures)))
        file.write('],\n"annotations":[\n')
        file.writelines(_separated(_annotations(captures, attributes, report)))
        file.write("]}\n")


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """COCO's uncompressed run lengths: of pixels column by column, outside and inside in turn, outside first."""
    columns = np.flatnonzero(mask.any(0))
    if not len(columns):
        return [mask.size]
    height = len(mask)
    pixels = np.zeros(height * (columns[-1] + 1 - columns[0]) + 2, np.bool_)  # one outside at each end
    pixels[1:-1] = mask.T[columns[0] : columns[-1] + 1].ravel()
    changes = np.flatnonzero(pixels[1:] != pixels[:-1]) + height * columns[0]
    runs = np.diff(changes, prepend=0, append=mask.size).tolist()
    return runs if runs[-1] else runs[:-1]


def keypoints_of(subject: Subject) -> Float[np.ndarray, "F 17 3"]:
    """World positions of COCO's keypoints; the face's are NaN where the subject's body is not the default body.

    On a rig of its own, the face of the fitted body moves with the head: the rig's head minus the body's.

    Raises:
        FileError: joints.npz is damaged.
    """
    joints, body = joints_of(subject).astype(np.float64), default_body()
    points = np.full((subject.frames, len(KEYPOINTS), 3), np.nan)
    points[:, len(FACE) :] = joints[:, _JOINTS]
    if len(subject.smpl.betas) > body.shape_basis.shape[-1]:
        return points
    smpl = subject.smpl
    poses = BodyPose.from_axis_angle(torch.from_numpy(smpl.theta), torch.from_numpy(smpl.translation))
    posed = _face().shape(torch.from_numpy(smpl.betas).double()).pose(poses.to(dtype=torch.float64))
    apart = np.linalg.norm(joints_from_body(subject, body), axis=-1).max(-1)
    face = posed.vertices[:, : 2 * len(FACE)].unflatten(1, (-1, 2)).mean(2).numpy()
    face += (joints[:, _HEAD] - posed.joints[:, _HEAD, :3, 3].numpy())[:, None]
    points[:, : len(FACE)] = np.where((apart <= SAME_BODY)[:, None, None], face, np.nan)
    return points


@functools.cache
def _face() -> BodyModel:
    """The default body, float64, of the face's vertices and one for each joint, where the body's shape puts it."""
    body = default_body().to(dtype=torch.float64)
    chosen = [vertex for pair in FACE.values() for vertex in pair]

    def few(values: Tensor) -> Tensor:
        return torch.cat([values[chosen], torch.tensordot(body.joint_regressor, values, 1)])

    return dataclasses.replace(
        body,
        template=few(body.template),
        shape_basis=few(body.shape_basis),
        pose_basis=few(body.pose_basis),
        joint_regressor=torch.eye(len(chosen) + J, dtype=torch.float64)[len(chosen) :],
        skin_weights=few(body.skin_weights),
    )


def visibility(
    view: View,
    points: Float[np.ndarray, "17 3"],
    masks: Sequence[UInt8[np.ndarray, "H W"]],
    depths: Sequence[UInt16[np.ndarray, "H W"]],
) -> tuple[Float[np.ndarray, "17 2"], list[int]]:
    """Pixels of keypoints in the world, pixel centres at +0.5, and COCO's visibility of each among all humans in view.

    A keypoint is visible if the surface at its pixel is at most THICKNESS in front of it, or if there is none. Stored
    depth does not reach beyond 16 m, where keypoints in a mask count as hidden.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels, far = view.project(points)
    seen = []
    for (x, y), z, thickness in zip(pixels, far, _THICKNESS, strict=True):
        if not (z > 0 and 0 <= x < view.width and 0 <= y < view.height):
            seen.append(0)
            continue
        at = int(y), int(x)
        surface = min((depth[at] for depth in depths if depth[at]), default=np.inf) * DEPTH_UNIT
        beyond = z > _FARTHEST and any(mask[at] >= THRESHOLD for mask in masks)
        seen.append(1 if beyond or z - surface > thickness else 2)
    return pixels, seen


@dataclasses.dataclass(frozen=True, eq=False)
class _Image:
    id: int
    subjects: tuple[Subject, ...]
    frame: int
    camera: int
    kind: str = "img"
    """Pass that is annotated where nothing is composed."""

    @property
    def view(self) -> View:
        return self.subjects[0].views[self.camera]

    @property
    def is_composed(self) -> bool:
        return len(self.subjects) > 1

    @property
    def file_name(self) -> str:
        first = self.subjects[0]
        path = capture_layout.picture_path(first.folder, self.kind, self.camera, self.frame)
        if self.is_composed:
            path = composed_path(first, self.frame, self.camera)
        return path.relative_to(first.folder.parent).as_posix()

    @property
    def record(self) -> dict[str, Any]:
        view = self.view
        return {
            "id": self.id,
            "file_name": self.file_name,
            "width": view.width,
            "height": view.height,
            "subjects": [subject.name for subject in self.subjects],
            "frame": self.frame,
            "camera": self.camera,
            "K": view.intrinsics.tolist(),
            "R": view.rotation.tolist(),
            "T": view.translation.tolist(),
        }

    def annotations(self, points: Sequence[Float[np.ndarray, "F 17 3"]]) -> Iterator[dict[str, Any]]:
        """All subjects of which the image shows a pixel, without ids; writes the image if it is composed."""
        kinds = PASSES if self.is_composed else PASSES[1:]
        stored = [subject.pictures(kinds, self.frame, self.camera) for subject in self.subjects]
        images, masks, depths = ([one[kind] for one in stored if kind in one] for kind in PASSES)
        hips = [float(self.view.project(own[self.frame][_HIPS].mean(0))[1]) for own in points]
        box = drawn_box([*images, *masks])
        parts = [mask[box] for mask in masks]
        shares = uncovered(parts, [depth[box] for depth in depths], hips)
        if self.is_composed:
            cut = [image[box] for image in images]
            write_composed(cut, shares, box, self.subjects[0], self.frame, self.camera)
        for subject, mask, part, share, own in zip(self.subjects, masks, parts, shares, points, strict=True):
            seen = np.zeros(mask.shape, np.bool_)
            seen[box] = share * part >= THRESHOLD
            if seen.any():
                pixels, visible = visibility(self.view, own[self.frame], masks, depths)
                yield {
                    **_outline(seen),
                    **({"amodal": _mask(mask >= THRESHOLD)} if len(masks) > 1 else {}),
                    **_keypoints(pixels, visible),
                    "subject": subject.name,
                    "smpl": {
                        "pose": _rounded(subject.smpl.theta[self.frame], 6),
                        "betas": _rounded(subject.smpl.betas, 6),
                        "translation": _rounded(subject.smpl.translation[self.frame], 6),
                    },
                }


def _mask(inside: Bool[np.ndarray, "H W"]) -> dict[str, Any]:
    return {"size": list(inside.shape), "counts": run_lengths(inside)}


def _outline(inside: Bool[np.ndarray, "H W"]) -> dict[str, Any]:
    columns, rows = np.flatnonzero(inside.any(0)), np.flatnonzero(inside.any(1))
    left, top = int(columns[0]), int(rows[0])
    return {
        "iscrowd": 0,
        "bbox": [left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top],
        "area": int(np.count_nonzero(inside)),
        "segmentation": _mask(inside),
    }


def _keypoints(pixels: Float[np.ndarray, "17 2"], visible: Sequence[int]) -> dict[str, Any]:
    indices = [place if v else [0, 0] for place, v in zip(_rounded(pixels - 0.5, 2), visible, strict=True)]
    return {
        "num_keypoints": sum(v > 0 for v in visible),
        "keypoints": [value for (x, y), v in zip(indices, visible, strict=True) for value in (x, y, v)],
    }


def groups(captures: Captures) -> list[tuple[Subject, ...]]:
    """The finished subjects of each image: those with the same cameras if they stand together, else each alone."""
    if captures.about.get("together") is None:
        return [(captures.subject(name),) for name in captures.subjects]
    found: dict[object, list[Subject]] = {}
    for subject in map(captures.subject, captures.subjects):
        cameras = [
            (*array.round(4).ravel().tolist(), view.width, view.height)
            for view in subject.views
            for array in (view.intrinsics, view.rotation, view.translation)
        ]
        found.setdefault((subject.frames, *cameras), []).append(subject)
    return [
        tuple(members[first : first + MOST_TOGETHER])
        for members in found.values()
        for first in range(0, len(members), MOST_TOGETHER)
    ]


def _images(captures: Captures) -> Iterator[_Image]:
    """All images by subjects, frame and camera, numbered from 1."""
    number, kind = 0, "hdri" if "hdri" in captures.passes else "img"
    for subjects in groups(captures):
        for frame in range(subjects[0].frames):
            for camera in range(len(subjects[0].views)):
                number += 1
                yield _Image(number, subjects, frame, camera, kind)


def _annotations(
    captures: Captures,
    attributes: Mapping[str, Mapping[str, Any]],
    report: Callable[[str], object],
) -> Iterator[str]:
    number, points = 0, []
    for image in _images(captures):
        if image.frame == image.camera == 0:
            points = [keypoints_of(subject) for subject in image.subjects]
        for annotation in image.annotations(points):
            number += 1
            about = {"id": number, "image_id": image.id, "category_id": CATEGORY["id"]}
            own = attributes.get(annotation["subject"])
            yield _line({**about, **annotation, **({} if own is None else {"attributes": own})})
        first = image.subjects[0]
        if (image.frame, image.camera) == (first.frames - 1, len(first.views) - 1):
            for subject in image.subjects:
                report(subject.name)


def _rounded(values: np.ndarray, digits: int) -> list[Any]:
    return (np.round(values.astype(np.float64), digits) + 0.0).tolist()  # + 0.0: no negative zeros


def _line(record: Mapping[str, Any]) -> str:
    return json.dumps(record, separators=(",", ":"), allow_nan=False)


def _separated(lines: Iterator[str]) -> Iterator[str]:
    """Lines of a JSON list."""
    for number, line in enumerate(lines):
        yield f",\n{line}" if number else line


FOLDER = "composed"
"""Folder of composed images, in that of the captures."""


def composed_path(subject: Subject, frame: int, camera: int) -> Path:
    """Path of a composed image, whose first human is `subject`."""
    root = subject.folder.parent
    return capture_layout.picture_path(root / FOLDER / subject.name, "img", camera, frame)


def write_composed(
    images: Sequence[UInt8[np.ndarray, "h w 3"]],
    shares: Float32[np.ndarray, "n h w"],
    box: Box,
    subject: Subject,
    frame: int,
    camera: int,
) -> None:
    """Write an image of all humans in a view, of whom `subject` is the first, over black, atomically.

    `images` and their `uncovered` shares are of the box alone. Raises FileError, OSError where the file cannot be
    written, or lies behind a link out of the captures.
    """
    path, view = composed_path(subject, frame, camera), subject.views[camera]
    image = np.zeros((view.height, view.width, 3), np.uint8)
    image[box] = compose(images, shares)
    with atomic_replace(path, subject.folder.parent) as partial:
        Image.fromarray(image).save(partial, format="JPEG", quality=JPEG_QUALITY, subsampling=0)


Box = tuple[slice, slice]
"""Rows and columns of a picture."""


def drawn_box(pictures: Sequence[UInt8[np.ndarray, "H W ..."]]) -> Box:
    """The smallest box around all pixels of images and masks that are not 0: there are no humans outside of it."""
    rows = _extent([picture.reshape(len(picture), -1).max(1) for picture in pictures])
    highest = [picture[rows].max(0, initial=0) for picture in pictures]
    return rows, _extent([of_column.reshape(len(of_column), -1).max(1) for of_column in highest])


def _extent(values: Sequence[UInt8[np.ndarray, "n"]]) -> slice:
    """From the first to the last place at which one of the values is not 0."""
    (places,) = np.nonzero(np.max(values, axis=0))
    return slice(places[0], places[-1] + 1) if len(places) else slice(0)


def uncovered(
    masks: Sequence[UInt8[np.ndarray, "H W"]], depths: Sequence[UInt16[np.ndarray, "H W"]], distances: Sequence[float]
) -> Float32[np.ndarray, "n H W"]:
    """The share of each pixel that nearer humans leave to each human.

    `distances` are the depths of the hips, metres, for pixels of a mask without a depth: edges.
    """
    depth, mask = np.stack(depths), np.stack(masks)
    place = np.where(depth > 0, depth * DEPTH_UNIT, np.reshape(distances, (-1, 1, 1)))
    order = place.argsort(0, kind="stable")
    left = (1 - np.take_along_axis(mask, order, 0).astype(np.float32) / 255).cumprod(0)
    shares = np.ones(mask.shape, np.float32)
    np.put_along_axis(shares, order[1:], left[:-1], 0)
    return shares


def compose(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], shares: Float32[np.ndarray, "n H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw all humans in linear light, nearer over farther; colours are premultiplied over black.

    `shares` are those of `uncovered`.
    """
    layers = zip(shares, images, strict=True)
    return srgb_bytes(np.sum([share[..., None] * LINEAR_OF_BYTE[image] for share, image in layers], axis=0))
