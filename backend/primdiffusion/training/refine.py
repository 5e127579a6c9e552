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
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from primdiffusion.capture.dataset import Views
from primdiffusion.formats.requests import Count, NotNegative, RayStep
from primdiffusion.formats.schema import Checked, Range
from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.human import Human
from primdiffusion.primitives.from_mesh import FULL_DENSITY
from primdiffusion.primitives.primitives import Payload
from primdiffusion.training.refine_views import PosedView, psnr_of, render_view, scenes_of
from primdiffusion.version import __version__

BETAS = (0.9, 0.99)
"""Adam's decay rates; short averages, because a run is a few hundred steps."""
WARM_UP = 10
"""Warm-up of the rates, in steps: Adam's first steps have the same length for any gradient."""
LARGEST_CHANGE = 3.0
"""Largest factor by which the side of a box grows or shrinks."""
MEASURED = 32
"""Views, evenly spaced, for the PSNR before and after."""


@dataclasses.dataclass(frozen=True)
class RefineSettings(Checked):
    """Settings of refinement. The rates were tuned on humans in detailed clothes."""

    steps: Count = 300
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
