"""Refine a human to match images: gradient descent on the payload, through the marcher.

    start = bare_body(betas)                        # or any other human, such as one from the encoder
    refined = refine(start, views).human            # views: images of several poses

`render.descent` does it. Nothing but the views holds the payload: some tens of views in several poses work well.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.capture.reader import Views
from primdiffusion.evaluation.metrics import psnr
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.human import Human, body_of, pose_body
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import from_mesh
from primdiffusion.primitives.primitives import Payload
from primdiffusion.render.descent import DescentSettings, descend, render_view
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import MarchSettings
from primdiffusion.version import __version__

MEASURED = 32
"""Views, evenly spaced, for the PSNR before and after."""
GREY = (128, 128, 128, 255)
"""Colour of a body without clothes, sRGB-encoded."""


@dataclasses.dataclass(frozen=True)
class Refined:
    """Result of a refinement."""

    human: Human
    """On the CPU."""
    psnr_before: float
    """Mean over up to MEASURED views, dB (`view_psnr`)."""
    psnr_after: float
    """The same after refinement."""


def refine(
    human: Human,
    views: Sequence[Views],
    settings: DescentSettings | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Refined:
    """Return the human with the same betas and a payload optimised to match the views; runs on the payload's device.

    `views` are records of one pose each, unbatched, with images [v, H, W]; their poses apply to a body with the human's
    betas. Deterministic for the same input, settings and device. `on_step` is called after each step; an exception that
    it raises cancels.

    Raises:
        ValueError: there are no views, they do not match their cameras, or masks are empty; the human is on another
            body or has NaN; the optimisation diverges.
        PictureOutOfMemory: images of this size do not fit into memory.
    """
    human.validate()
    scenes = scenes_of(human, views)
    settings = settings or DescentSettings()
    payload = descend(human.payload, scenes, settings, on_step)
    measured = scenes[:: math.ceil(len(scenes) / MEASURED)]
    before, after = (float(psnr_of(measured, candidate).mean()) for candidate in (human.payload, payload))
    provenance = {
        **human.provenance,
        "refined_steps": settings.steps,
        "refined_views": len(scenes),
        "version": __version__,
    }
    refined = dataclasses.replace(human, payload=payload, provenance=provenance).to("cpu").validate()
    return Refined(refined, before, after)


def view_psnr(human: Human, views: Sequence[Views]) -> Float[Tensor, "n"]:
    """PSNR (dB) of each whole image, sRGB-encoded over black, in the order of the views. Raises as `refine`."""
    return psnr_of(scenes_of(human.validate(), views), human.payload)


def scenes_of(human: Human, views: Sequence[Views]) -> list[PosedView]:
    """Return every image with camera and frames, on the human's device; each pose is computed once.

    Raises ValueError for no views, views that do not match their cameras, and more betas than the human's body has.
    """
    body, anchors = body_of(human)
    components = body.shape_basis.shape[-1]
    if len(human.betas) > components:
        raise ValueError(
            f"the human has {len(human.betas)} betas, its body {components}: it was captured on another body"
        )
    if not views or not any(record.rgba.shape[0] for record in views):
        raise ValueError("there are no views to refine from: give images of at least one view")
    device, scenes = human.payload.density.device, []
    for number, record in enumerate(views):
        _check(number, record)
        vertices = pose_body(human.betas.cpu().float(), record.pose.to("cpu"), body).vertices
        frames = attach(anchors, vertices, body.faces).to(device)
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
        raise ValueError(f"no mask of views {number} covers the subject: omit this frame, or give it masks")


@torch.no_grad()
def psnr_of(scenes: Sequence[PosedView], payload: Payload) -> Float[Tensor, "n"]:
    """See `view_psnr`."""
    found = []
    for scene in scenes:
        image = encode_srgb(render_view(scene, payload, MarchSettings().step).rgb.clamp(0, 1))
        found.append(psnr(image, scene.rgba[..., :3].float() / 255))
    return torch.stack(found).cpu()


def bare_body(betas: Float[Tensor, "n"]) -> Human:
    """Return the default body with these betas, grey; takes about 3 s.

    Raises ValueError for more betas than the body has.
    """
    body = default_body()
    vertices = body.shape(betas).vertices
    skin = TexturedPart(
        name="body",
        vertices=vertices.double().numpy(),
        faces=body.faces.numpy().astype(np.int32),
        corner_uv=body.uv[body.uv_faces].numpy(),
        texture=np.array([[GREY]], np.uint8),
        skin_index=np.zeros((len(body.template), 1), np.int32),
        skin_weight=np.ones((len(body.template), 1)),
    )
    payload = from_mesh(TexturedMesh((skin,)), attach(default_anchors(), vertices, body.faces))
    return Human(payload, betas, {"start": "the bare body"}).validate()
