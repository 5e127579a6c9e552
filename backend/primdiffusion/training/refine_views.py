"""Inputs of refinement: validated views with cameras and frames, and the humans to start from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.capture.dataset import Views
from primdiffusion.capture.people_files import read_person
from primdiffusion.evaluation.image_metrics import psnr
from primdiffusion.failures import PictureOutOfMemory, out_of_memory
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.human import Human, body_of, pose_body
from primdiffusion.people.payloads import rest_frames
from primdiffusion.primitives.anchors import attach
from primdiffusion.primitives.from_mesh import from_mesh
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march

GREY = (128, 128, 128, 255)
"""sRGB-encoded."""


def view_psnr(human: Human, views: Sequence[Views]) -> Float[Tensor, "n"]:
    """PSNR (dB) of each whole image, sRGB-encoded over black, in the order of the views. Raises as `refine`."""
    return psnr_of(scenes_of(human.validate(), views), human.payload)


class PosedView(NamedTuple):
    """An image with its camera and the frames of the primitives."""

    frames: Frames
    camera: Camera
    target: Tensor
    """uint8 [H, W, 4]."""


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
        found.append(psnr(image, scene.target[..., :3].float() / 255))
    return torch.stack(found).cpu()


def render_view(scene: PosedView, payload: Payload, step: float) -> Rendering:
    """Render the payload for the scene's camera. Raises PictureOutOfMemory."""
    try:
        return march(Primitives.place(scene.frames, payload), scene.camera, MarchSettings(step=step))
    except (MemoryError, RuntimeError) as e:
        if out_of_memory(e):
            raise PictureOutOfMemory(scene.camera.width, scene.camera.height) from e
        raise


def bare_body(betas: Float[Tensor, "n"]) -> Human:
    """Return the default body with these betas, grey; takes about 3 s.

    Raises ValueError for more betas than the body has.
    """
    body = default_body()
    skin = TexturedPart(
        name="body",
        vertices=body.shape(betas).vertices.double().numpy(),
        faces=body.faces.numpy().astype(np.int32),
        corner_uv=body.uv[body.uv_faces].numpy(),
        texture=np.array([[GREY]], np.uint8),
        skin_index=np.zeros((len(body.template), 1), np.int32),
        skin_weight=np.ones((len(body.template), 1)),
    )
    return _as_human(TexturedMesh((skin,)), betas, "the bare body")


def meshed_person(path: str | Path) -> Human:
    """Return a human of `primdiffusion people`, a .glb in the rest pose of the default body; takes about 3 s.

    Raises:
        FileNotFoundError, FileError: as `read_person`.
        ValueError: the mesh is empty.
    """
    person = read_person(path)
    return _as_human(person.mesh, torch.from_numpy(person.betas).float(), Path(path).name)


def _as_human(mesh: TexturedMesh, betas: Float[Tensor, "n"], origin: str) -> Human:
    payload = from_mesh(mesh, rest_frames(betas.double().numpy()))
    return Human(payload, betas, {"start": origin}).validate()
