"""Refine a human to match images: gradient descent on the payload, through the marcher.

    start = bare_body(betas)                        # or any other human, such as one from the encoder
    refined = refine(start, views).human            # views: images of several poses

Adam optimises sRGB-encoded colours, densities and the logarithm of box sizes. The
objective is that of stage 1 (paper sec. 3.2: L_rgb, L_sil), on random views. Values that no view shows have no
gradient and stay bit-identical. There is no other regulariser: it overfits to a few views of one pose, and other sides
get worse; some tens of views in several poses work well.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.capture.dataset import Views
from primdiffusion.capture.people_files import read_person
from primdiffusion.evaluation.image_metrics import psnr
from primdiffusion.failures import PictureOutOfMemory, out_of_memory
from primdiffusion.formats.requests import Count, NotNegative, RayStep
from primdiffusion.formats.schema import Checked, Range
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.human import Human, body_of, pose_body
from primdiffusion.people.payloads import rest_frames
from primdiffusion.primitives.anchors import attach
from primdiffusion.primitives.from_mesh import FULL_DENSITY, from_mesh
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.march import MarchSettings, Rendering, march
from primdiffusion.version import __version__

BETAS = (0.9, 0.99)
"""Adam's decay rates; short averages, because a run is a few hundred steps."""
WARM_UP = 10
"""Warm-up of the rates, in steps: Adam's first steps have the same length for any gradient."""
LARGEST_CHANGE = 3.0
"""Largest factor by which the side of a box grows or shrinks."""
MEASURED = 32
"""Views, evenly spaced, for the PSNR before and after."""
GREY = (128, 128, 128, 255)
"""Colour of a body without clothes, sRGB-encoded."""


@dataclasses.dataclass(frozen=True)
class RefineSettings(Checked):
    """Settings of refinement. The rates were tuned on humans in detailed clothes."""

    steps: Count = 150
    """Optimiser steps."""
    views: Count = 2
    """Images per step."""
    colour_rate: NotNegative = 0.04
    """Learning rate of sRGB-encoded colours in 0 ... 1."""
    density_rate: NotNegative = 0.04
    """Learning rate of densities in units of FULL_DENSITY."""
    scale_rate: NotNegative = 0.03
    """Learning rate of the logarithm of box sizes; 0 keeps them."""
    last_rate: NotNegative = 0.1
    """Fraction of the rates at the end of their cosine decay."""
    largest_density: Annotated[float, Range(1)] = FULL_DENSITY
    """1/m; more gains a tenth of a dB, and exceeds the range of the training set of the diffusion model."""
    silhouette: NotNegative = 0.05
    """Weight of the mean square error of the silhouette, relative to that of the colours."""
    step: RayStep = 0.006
    """Metres between samples of a ray."""
    seconds: Annotated[float, Range(0)] = math.inf
    """Time limit, checked after each step; the decay of the rates does not adapt to it."""
    seed: int = 0
    """Seed of the order of views."""


class RefineStep(NamedTuple):
    """Progress after a step."""

    number: int
    """From 1."""
    loss: float


@dataclasses.dataclass(frozen=True)
class Refined:
    """Result of a refinement."""

    human: Human
    """On the CPU."""
    psnr_before: float
    """Mean over up to MEASURED views, dB (`view_psnr`)."""
    psnr_after: float
    """The same after refinement."""
    steps: int
    """Completed steps; fewer than requested if time ran out."""
    seconds: float
    """Duration of the steps."""


def refine(
    human: Human,
    views: Sequence[Views],
    settings: RefineSettings = RefineSettings(),
    on_step: Callable[[RefineStep], None] | None = None,
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
    start = human.payload.map(lambda values: values.detach().float())
    leaves = _Leaves.of(start)
    groups = zip(leaves, (settings.colour_rate, settings.density_rate, settings.scale_rate), strict=True)
    adam = torch.optim.Adam([{"params": [leaf], "lr": rate} for leaf, rate in groups], betas=BETAS, fused=True)
    fall = torch.optim.lr_scheduler.LambdaLR(adam, lambda done: _share_of_rate(done, settings))
    chosen = _shuffled(scenes, settings.seed)
    covered = sum(float(scene.target[..., 3].sum()) for scene in scenes) / 255 / len(scenes)
    began, number = time.perf_counter(), 0
    for number in range(1, settings.steps + 1):
        adam.zero_grad()
        payload = leaves.payload(start)
        losses = [_loss(scene, payload, settings) for scene in itertools.islice(chosen, settings.views)]
        loss = torch.stack(losses).mean() / covered
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ValueError(f"refinement diverged at step {number} (loss {value}): use smaller rates")
        loss.backward()
        adam.step()
        fall.step()
        leaves.clamp_(settings.largest_density)
        if on_step is not None:
            on_step(RefineStep(number, value))
        if time.perf_counter() - began > settings.seconds:
            break
    seconds = time.perf_counter() - began
    payload = leaves.result(start)
    measured = scenes[:: math.ceil(len(scenes) / MEASURED)]
    before, after = (float(psnr_of(measured, candidate).mean()) for candidate in (start, payload))
    provenance = {**human.provenance, "refined_steps": number, "refined_views": len(scenes), "version": __version__}
    refined = dataclasses.replace(human, payload=payload, provenance=provenance).to("cpu").validate()
    return Refined(refined, before, after, number, seconds)


class _Leaves(NamedTuple):
    """The optimised tensors."""

    colour: Tensor
    """sRGB-encoded."""
    density: Tensor
    """In units of FULL_DENSITY."""
    log_scale: Tensor
    """Logarithm of box sizes relative to the start."""

    @classmethod
    def of(cls, start: Payload) -> _Leaves:
        colour = encode_srgb(start.rgb.clamp(0, 1))
        density = start.density.clamp_min(0) / FULL_DENSITY
        return cls(*(leaf.requires_grad_() for leaf in (colour, density, torch.zeros_like(start.delta_scale))))

    def payload(self, start: Payload) -> Payload:
        scale = start.delta_scale * self.log_scale.exp()
        return Payload(decode_srgb(self.colour), self.density * FULL_DENSITY, scale)

    @torch.no_grad()
    def clamp_(self, largest_density: float) -> None:
        """Clamp to valid values, after the step: clamping in the forward pass would stop the gradient at the bounds."""
        self.colour.clamp_(0, 1)
        self.density.clamp_(0, largest_density / FULL_DENSITY)
        self.log_scale.clamp_(-math.log(LARGEST_CHANGE), math.log(LARGEST_CHANGE))

    @torch.no_grad()
    def result(self, start: Payload) -> Payload:
        """The payload, bit-identical to the start where nothing changed."""
        now, then = self.payload(start), _Leaves.of(start)
        return Payload(
            torch.where(self.colour == then.colour, start.rgb, now.rgb),
            torch.where(self.density == then.density, start.density, now.density),
            torch.where(self.log_scale == 0, start.delta_scale, now.delta_scale),
        )


def _shuffled(scenes: Sequence[PosedView], seed: int) -> Iterator[PosedView]:
    """Shuffled views without end, epoch by epoch."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        for place in torch.randperm(len(scenes), generator=generator).tolist():
            yield scenes[place]


def _share_of_rate(done: int, settings: RefineSettings) -> float:
    fall = 0.5 + 0.5 * math.cos(math.pi * min(done / settings.steps, 1))
    return min(1, (done + 1) / WARM_UP) * (settings.last_rate + (1 - settings.last_rate) * fall)


def _loss(scene: PosedView, payload: Payload, settings: RefineSettings) -> Tensor:
    """L_rgb + silhouette * L_sil, summed over pixels; L_rgb is the mean over channels."""
    rendering = render_view(scene, payload, settings.step)
    target = scene.target.float() / 255
    colour = (encode_srgb(rendering.rgb) - target[..., :3]).square().mean(-1)
    return (colour + settings.silhouette * (rendering.alpha - target[..., 3]).square()).sum()


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
