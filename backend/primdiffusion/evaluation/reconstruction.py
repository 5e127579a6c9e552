"""How well an encoder reconstructs people: its pictures against captured ones, all views and poses (paper Table 3).

A person is encoded once, from a few views of one pose; what comes out is drawn from every camera in every pose.
Pictures from cameras that were given, and in the pose that was, are told apart from those the encoder never saw.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Protocol

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from primdiffusion.body.model import BodyPose
from primdiffusion.capture.conditioning import conditioning_views, default_betas, spread_cameras
from primdiffusion.capture.dataset import Views
from primdiffusion.capture.reader import Captures
from primdiffusion.evaluation.image_metrics import Lpips, bounding_box, overlap, psnr, ssim
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march


class Reconstructor(Protocol):
    """What is evaluated: `primdiffusion.encoder.encode.EncoderModel`, or anything else that makes people of views."""

    def encode(self, views: Views, betas: Float[Tensor, "n"]) -> Payload:
        """The payload of the person in the views (unbatched, of one pose)."""
        ...

    def place(self, payload: Payload, betas: Float[Tensor, "n"], pose: BodyPose) -> Primitives:
        """The payload on the person's body in a pose."""
        ...


@dataclasses.dataclass(frozen=True)
class EvaluationSettings:
    """Which pictures count, and what the encoder is given."""

    subjects: tuple[str, ...] = ()
    """Names; empty: everybody."""
    frames: tuple[int, ...] = ()
    """Poses that are compared; empty: all."""
    cameras: tuple[int, ...] = ()
    """Views that are compared; empty: all."""
    given_views: int = 8
    """Views that the encoder is given, spread around the person."""
    given_frame: int = 0
    """The pose in which."""
    size: int = 512
    """Pixels a side; larger pictures are averaged down to it."""
    march: MarchSettings = MarchSettings()  # noqa: RUF009  frozen

    def __post_init__(self) -> None:
        """Raises ValueError for pictures without pixels and people without views."""
        for name, least in (("given_views", 1), ("size", 11)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} of the evaluation is {getattr(self, name)}: it must be {least} or more")


@dataclasses.dataclass(frozen=True)
class Likeness:
    """How alike two pictures of a person are; None in the box where the mask is empty, LPIPS where it was not asked."""

    psnr: float
    """dB, of the whole picture over black."""
    ssim: float
    psnr_box: float | None
    """dB, within the box around the target's mask."""
    ssim_box: float | None
    mask_iou: float
    """Of the pixels that are at least half covered."""
    lpips: float | None = None


FIGURES = tuple(field.name for field in dataclasses.fields(Likeness))


@dataclasses.dataclass(frozen=True)
class PictureScore:
    """One picture of one person."""

    subject: str
    frame: int
    camera: int
    given_view: bool
    """Whether its camera is one of those that the encoder was given."""
    given_pose: bool
    likeness: Likeness


SPLITS = {
    "all": "all views, all poses",
    "given_views_given_pose": "given views, given pose",
    "novel_views_given_pose": "novel views, given pose",
    "given_views_novel_poses": "given views, novel poses",
    "novel_views_novel_poses": "novel views, novel poses",
}
"""Parts of the pictures that are averaged, and how they are called; `all` is the paper's way."""


@dataclasses.dataclass(frozen=True)
class Means:
    """Means over the pictures of a part; None where none of them has the figure."""

    pictures: int
    psnr: float | None
    """Mean of the pictures' decibels."""
    ssim: float | None
    psnr_box: float | None
    ssim_box: float | None
    mask_iou: float | None
    lpips: float | None


@torch.no_grad()
def evaluate(
    model: Reconstructor, captures: Captures, settings: EvaluationSettings | None = None, lpips: Lpips | None = None
) -> Iterator[PictureScore]:
    """Scores of all pictures that the settings name, one after the other; the same for the same model and captures.

    Drawn on the device of the payloads. A 512 x 512 picture takes a CPU about a sixth of a second.

    Raises:
        KeyError: there is no such subject.
        FileNotFoundError, ConditioningError, CaptureFileError, ArrayFileError, BodyFileError: a file is missing or
            damaged, there is no such frame or camera, or a subject is of another body model.
    """
    settings = settings or EvaluationSettings()
    for name in settings.subjects or captures.subjects:
        subject = captures.subject(name)
        betas = default_betas(subject)
        given = spread_cameras(subject, settings.given_frame, settings.given_views)
        views = conditioning_views(captures, name, settings.given_frame, given, settings.size)
        payload = model.encode(views, betas)
        device = payload.density.device
        for frame in settings.frames or range(subject.frames):
            cameras = settings.cameras or tuple(range(len(subject.views)))
            targets = conditioning_views(captures, name, frame, cameras, settings.size)
            primitives = model.place(payload.to("cpu"), betas, targets.pose).to(device)
            for place, camera in enumerate(cameras):
                view = targets.camera.map(lambda tensor, place=place: tensor[place])
                rendering = march(primitives, view.to(device), settings.march)
                yield PictureScore(
                    subject=name,
                    frame=frame,
                    camera=camera,
                    given_view=camera in given,
                    given_pose=frame == settings.given_frame,
                    likeness=compare(rendering, targets.rgba[place].to(device), lpips),
                )


def compare(rendering: Rendering, rgba: UInt8[Tensor, "H W 4"], lpips: Lpips | None = None) -> Likeness:
    """A drawn picture against a captured one (sRGB-encoded over black, and the mask)."""
    image, target = picture(rendering), rgba[..., :3].to(rendering.rgb.dtype) / 255
    mask = rgba[..., 3] >= 128
    box = bounding_box(rgba[..., 3] > 0)
    return Likeness(
        psnr=float(psnr(image, target)),
        ssim=float(ssim(image, target)),
        psnr_box=None if box is None else float(psnr(box.cut(image), box.cut(target))),
        ssim_box=None if box is None else float(ssim(box.cut(image), box.cut(target))),
        mask_iou=overlap(rendering.alpha >= 0.5, mask),
        lpips=None if lpips is None else float(lpips(image, target)),
    )


def picture(rendering: Rendering) -> Float[Tensor, "*b H W 3"]:
    """What a rendering looks like over black: sRGB-encoded, in [0, 1]."""
    return encode_srgb(rendering.rgb.clamp(0, 1))


def summary(scores: Iterable[PictureScore]) -> dict[str, Means]:
    """Means over each of the `SPLITS`."""
    held = list(scores)
    parts = {
        "all": held,
        "given_views_given_pose": [score for score in held if score.given_view and score.given_pose],
        "novel_views_given_pose": [score for score in held if not score.given_view and score.given_pose],
        "given_views_novel_poses": [score for score in held if score.given_view and not score.given_pose],
        "novel_views_novel_poses": [score for score in held if not score.given_view and not score.given_pose],
    }
    return {name: _means([score.likeness for score in part]) for name, part in parts.items()}


def _means(likenesses: list[Likeness]) -> Means:
    figures = {}
    for name in FIGURES:
        values = [value for value in (getattr(one, name) for one in likenesses) if value is not None]
        figures[name] = sum(values) / len(values) if values else None
    return Means(len(likenesses), **figures)


def table(means: Mapping[str, Means]) -> str:
    """The summary as a markdown table, a part a row."""
    lines = ["| pictures of | number | PSNR | SSIM | PSNR in box | SSIM in box | mask IoU | LPIPS |", "|---" * 8 + "|"]
    formats = {"psnr": ".2f", "ssim": ".4f", "psnr_box": ".2f", "ssim_box": ".4f", "mask_iou": ".4f", "lpips": ".4f"}
    for name, part in means.items():
        figures = [getattr(part, figure) for figure in formats]
        cells = ["-" if v is None else format(v, f) for v, f in zip(figures, formats.values(), strict=True)]
        lines.append(f"| {SPLITS[name]} | {part.pictures} | {' | '.join(cells)} |")
    return "\n".join(lines)
