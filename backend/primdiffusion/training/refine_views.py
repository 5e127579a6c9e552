"""Pictures to refine a person from: checked, each with its camera and the boxes' frames, and how well one is met."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.capture.dataset import Views
from primdiffusion.evaluation.image_metrics import psnr
from primdiffusion.failures import PictureOutOfMemory, out_of_memory
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import Human, pose_body
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march


def view_psnr(human: Human, views: Sequence[Views]) -> Float[Tensor, "n"]:
    """PSNR of each whole picture, of sRGB-encoded colours over black, dB; the views in order.

    Raises what `refine` does of its views and human.
    """
    return psnr_of(scenes_of(human.validate(), views), human.payload)


class PosedView(NamedTuple):
    """One picture and where the boxes are in it."""

    frames: Frames
    camera: Camera
    target: Tensor
    """uint8 [H, W, 4]."""


def scenes_of(human: Human, views: Sequence[Views]) -> list[PosedView]:
    """Every picture as a scene on the human's device; their bodies are posed once.

    Raises ValueError where there are none, they do not fit their cameras, or the human is of another body.
    """
    components = default_body().shape_basis.shape[-1]
    if len(human.betas) > components:
        raise ValueError(
            f"the person has {len(human.betas)} betas, the default body {components}: it is another body's"
        )
    if not views or not any(record.rgba.shape[0] for record in views):
        raise ValueError("there are no views to refine from: give pictures of the person from at least one side")
    device, scenes = human.payload.density.device, []
    for number, record in enumerate(views):
        _check(number, record)
        vertices = pose_body(human.betas.cpu().float(), record.pose.to("cpu")).vertices
        frames = attach(default_anchors(), vertices, default_body().faces).to(device)
        record = record.to(device)
        for camera, rgba in enumerate(record.rgba):
            one = record.camera.map(lambda values, camera=camera: values[camera])
            scenes.append(PosedView(frames, one, rgba))
    return scenes


def _check(number: int, record: Views) -> None:
    camera, rgba = record.camera, record.rgba
    expected = (*camera.intrinsics.shape[:-2], camera.height, camera.width, 4)
    if rgba.dtype != torch.uint8 or tuple(rgba.shape) != expected or rgba.ndim != 4:
        raise ValueError(
            f"pictures and masks of views {number} are {rgba.dtype} {tuple(rgba.shape)}, their cameras see "
            f"{expected}: give uint8 [v, H, W, 4] of one pose"
        )
    if record.pose.translation.ndim != 1:
        raise ValueError(
            f"views {number} have poses {tuple(record.pose.translation.shape[:-1])}: give one pose a record"
        )
    if not record.mask.any():
        raise ValueError(f"no mask of views {number} shows a person: leave out this frame, or give it masks")


@torch.no_grad()
def psnr_of(scenes: Sequence[PosedView], payload: Payload) -> Float[Tensor, "n"]:
    """As `view_psnr`."""
    found = []
    for scene in scenes:
        image = encode_srgb(drawn(scene, payload, MarchSettings().step).rgb.clamp(0, 1))
        found.append(psnr(image, scene.target[..., :3].float() / 255))
    return torch.stack(found).cpu()


def drawn(scene: PosedView, payload: Payload, step: float) -> Rendering:
    """The payload as the scene's camera sees it. Raises PictureOutOfMemory."""
    try:
        return march(Primitives.place(scene.frames, payload), scene.camera, MarchSettings(step=step))
    except (MemoryError, RuntimeError) as e:
        if out_of_memory(e):
            raise PictureOutOfMemory(scene.camera.width, scene.camera.height) from e
        raise
