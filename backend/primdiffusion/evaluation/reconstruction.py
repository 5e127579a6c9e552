"""Reconstruction quality of an encoder: renders compared with captures, over all views and poses (paper Table 3).

Each subject is encoded once, from a few views of one pose, then rendered from every camera in every pose. Metrics are
reported separately for input and novel views, and for the input pose and novel poses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.capture.conditioning import body_betas, conditioning_views, spread_cameras
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.model import EncoderModel
from primdiffusion.evaluation.images import markdown_table
from primdiffusion.evaluation.metrics import Lpips, bounding_box, overlap, psnr, ssim
from primdiffusion.formats.requests import Count
from primdiffusion.formats.schema import Checked, Range
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.render.march import MarchSettings, march


@dataclasses.dataclass(frozen=True)
class EvaluationSettings(Checked):
    """The images that are compared, and the input of the encoder."""

    subjects: tuple[str, ...] = ()
    """Names; empty: all."""
    frames: tuple[int, ...] = ()
    """Evaluated poses; empty: all."""
    cameras: tuple[int, ...] = ()
    """Evaluated views; empty: all."""
    given_views: Count = 8
    """Number of input views, spread around the subject."""
    given_frame: int = 0
    """Pose of the input views."""
    size: Annotated[int, Range(11)] = 512
    """Image width and height, pixels; larger captures are downsampled, and SSIM needs its window of 11."""
    march: MarchSettings = MarchSettings()  # noqa: RUF009  frozen


@dataclasses.dataclass(frozen=True)
class ImageMetrics:
    """Metrics of one image; box metrics are None if the mask is empty, LPIPS if it was not requested."""

    psnr: float
    """Over the whole image on black, dB."""
    ssim: float
    psnr_box: float | None
    """Within the bounding box of the target's mask, dB."""
    ssim_box: float | None
    mask_iou: float
    """Intersection over union of the masks of pixels that are at least half covered."""
    lpips: float | None = None


Means = dict[str, float | None]
FIGURES = tuple(field.name for field in dataclasses.fields(ImageMetrics))


@dataclasses.dataclass(frozen=True)
class PictureScore:
    """Metrics of one view of one subject in one pose."""

    subject: str
    frame: int
    camera: int
    given_view: bool
    """Whether the encoder saw this camera's view."""
    given_pose: bool
    likeness: ImageMetrics
    """Named as in the JSON report."""


SPLITS = {
    "all": "all views, all poses",
    "given_views_given_pose": "given views, given pose",
    "novel_views_given_pose": "novel views, given pose",
    "given_views_novel_poses": "given views, novel poses",
    "novel_views_novel_poses": "novel views, novel poses",
}
"""Subsets that are averaged, and their titles; the paper reports `all`."""


@torch.no_grad()
def evaluate(
    model: EncoderModel, captures: Captures, settings: EvaluationSettings | None = None, lpips: Lpips | None = None
) -> Iterator[PictureScore]:
    """Yield the metrics of every image that the settings select; deterministic.

    Of `model`, `body`, `encode` and `place` are used. Images are rendered on the device of the payloads; one of
    512 x 512 takes about a sixth of a second on CPU.

    Raises:
        KeyError: unknown subject.
        FileNotFoundError, FileError: a file is missing or damaged.
        ValueError: a frame or camera does not exist, or a subject has another body model.
    """
    settings = settings or EvaluationSettings()
    for name in settings.subjects or captures.subjects:
        subject = captures.subject(name)
        betas = body_betas(subject, model.body)
        given = spread_cameras(subject, settings.given_frame, settings.given_views, model.body)
        views = conditioning_views(captures, name, settings.given_frame, given, settings.size)
        payload = model.encode(views, betas)
        device = payload.density.device
        for frame in settings.frames or range(subject.frames):
            cameras = settings.cameras or tuple(range(len(subject.views)))
            targets = conditioning_views(captures, name, frame, cameras, settings.size)
            primitives = model.place(payload.to("cpu"), betas, targets.pose).to(device)
            for index, camera in enumerate(cameras):
                view = targets.camera.map(lambda tensor, index=index: tensor[index])
                drawn = march(primitives, view.to(device), settings.march)
                rgba = torch.cat([encode_srgb(drawn.rgb.clamp(0, 1)), drawn.alpha[..., None]], -1)
                target = targets.rgba[index].to(device).to(rgba.dtype) / 255
                yield PictureScore(
                    subject=name,
                    frame=frame,
                    camera=camera,
                    given_view=camera in given,
                    given_pose=frame == settings.given_frame,
                    likeness=image_metrics(rgba, target, lpips),
                )


def image_metrics(
    image: Float[Tensor, "h w 4"], target: Float[Tensor, "h w 4"], lpips: Lpips | None = None
) -> ImageMetrics:
    """Compare a picture with the true one; both have sRGB-encoded colours over black, and alpha."""
    pair = image[..., :3], target[..., :3]
    box = bounding_box(target[..., 3] > 0)
    cut = None if box is None else (box.cut(pair[0]), box.cut(pair[1]))
    return ImageMetrics(
        psnr=float(psnr(*pair)),
        ssim=float(ssim(*pair)),
        psnr_box=None if cut is None else float(psnr(*cut)),
        ssim_box=None if cut is None else float(ssim(*cut)),
        mask_iou=overlap(image[..., 3] >= 0.5, target[..., 3] >= 0.5),
        lpips=None if lpips is None else float(lpips(*pair)),
    )


def summary(scores: Iterable[PictureScore]) -> dict[str, Means]:
    """Number of pictures and means of the metrics in each of the `SPLITS`; None for metrics that no image has."""
    parts: dict[str, list[ImageMetrics]] = {name: [] for name in SPLITS}
    for score in scores:
        views = "given_views" if score.given_view else "novel_views"
        for name in ("all", f"{views}_given_pose" if score.given_pose else f"{views}_novel_poses"):
            parts[name].append(score.likeness)
    return {name: _means(part) for name, part in parts.items()}


def _means(metrics: list[ImageMetrics]) -> Means:
    figures: Means = {"pictures": len(metrics)}
    for name in FIGURES:
        values = [value for value in (getattr(one, name) for one in metrics) if value is not None]
        figures[name] = sum(values) / len(values) if values else None
    return figures


def table(means: Mapping[str, Means]) -> str:
    """Format the summary as a Markdown table, a row a subset."""
    texts = []
    for name, part in means.items():
        figures = [(part[figure], ".2f" if figure.startswith("psnr") else ".4f") for figure in FIGURES]
        texts.append([SPLITS[name], str(part["pictures"]), *("-" if v is None else format(v, f) for v, f in figures)])
    headings = ("pictures of", "number", "PSNR", "SSIM", "PSNR in box", "SSIM in box", "mask IoU", "LPIPS")
    return markdown_table(headings, texts)
