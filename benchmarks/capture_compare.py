"""Compares captures from Cycles and from the rasteriser on the same views, and checks where joints are projected."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.reader import Captures, Subject
from primdiffusion.capture.render import JPEG_QUALITY, set_up_capture, srgb_bytes
from primdiffusion.capture.sheet import default_joints, joints_of
from primdiffusion.formats.picture_files import DEPTH_UNIT
from primdiffusion.raster.multisample import render_view

SAME_DEPTH_M = 0.002


@dataclasses.dataclass(frozen=True)
class Difference:
    mask_iou: float
    """Intersection over union of the masks, where their value is above one half."""
    squared: float
    """Mean squared difference of colour bytes over pixels that either covers, both from JPEGs of the same kind."""
    depth_share: float
    """Share of pixels with a depth in either picture whose depths agree within SAME_DEPTH_M."""
    part_share: float
    """Share of those pixels that show the same part in both pictures."""
    shift_px: float
    """Displacement between the two pictures in pixels."""


def compare(captures: Captures, people: dict, samples: int) -> list[Difference]:
    """Draws every view of `captures` again with the rasteriser, from the SMPL parameters and cameras on disk."""
    differences = []
    for name in captures.subjects:
        subject = captures.subject(name)
        smpl = subject.smpl
        poses = BodyPose.from_axis_angle(torch.from_numpy(smpl.theta), torch.from_numpy(smpl.translation))
        sitting = set_up_capture(read_person(people[name]), poses, subject.views)
        for frame in range(subject.frames):
            posed = sitting.figure.posed(sitting.skinning[frame])
            for camera, view in enumerate(subject.views):
                differences.append(_difference(subject, frame, camera, render_view(posed, view, samples)))
    return differences


def joint_error_px(subject: Subject) -> float:
    """The largest distance between joints saved with the captures and those of the backend's body, in pixels."""
    saved, ours = joints_of(subject), default_joints(subject)
    differences = [view.project(ours)[0] - view.project(saved)[0] for view in subject.views]
    return float(np.linalg.norm(differences, axis=-1).max())


def _difference(subject: Subject, frame: int, camera: int, shot) -> Difference:
    stored = {kind: subject.picture(kind, frame, camera) for kind in ("img", "mask", "depth", "part")}
    colours, coverage = srgb_bytes(shot.rgb), np.round(shot.coverage * 255)
    ours, theirs = coverage > 127, stored["mask"] > 127
    covered = (coverage > 0) | (stored["mask"] > 0)
    difference = _as_blender_stores(colours)[covered].astype(float) - stored["img"][covered]
    depth = stored["depth"] * DEPTH_UNIT
    either = (depth > 0) | (shot.depth > 0)
    return Difference(
        mask_iou=float((ours & theirs).sum() / (ours | theirs).sum()),
        squared=float((difference**2).mean()),
        depth_share=float((np.abs(depth - shot.depth) < SAME_DEPTH_M)[either].mean()),
        part_share=float((stored["part"] == shot.part)[either].mean()),
        shift_px=_shift(stored["img"].astype(float), colours.astype(float)),
    )


def _as_blender_stores(colours: np.ndarray) -> np.ndarray:
    """The colours after a JPEG with half the colour resolution, as Blender writes it; the rasteriser's have full."""
    file = io.BytesIO()
    Image.fromarray(colours).save(file, "JPEG", quality=JPEG_QUALITY, subsampling="4:2:0")
    with Image.open(file) as picture:
        return np.asarray(picture)


def _shift(first: np.ndarray, second: np.ndarray) -> float:
    """The displacement in pixels that explains most of the difference of two pictures (Lucas and Kanade 1981)."""
    down, across = np.gradient(second, axis=(0, 1))
    gradients = np.stack([across.ravel(), down.ravel()], -1)
    return float(np.linalg.norm(np.linalg.lstsq(gradients, (first - second).ravel(), rcond=None)[0]))
