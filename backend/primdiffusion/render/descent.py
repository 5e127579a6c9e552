"""Fit a payload to images by gradient descent through the marcher.

The objective is that of stage 1 (paper sec. 3.2: L_rgb, L_sil), on random views. Adam optimises sRGB-encoded colours,
densities and the logarithm of box sizes, which the linear solve (`inverse`) keeps. Values that no view shows have no
gradient and stay bit-identical. The only regulariser is a pull towards the start, off by default.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam as adam_step

from primdiffusion.formats.requests import Count, NotNegative, RayStep
from primdiffusion.formats.schema import Checked, Range
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.primitives.from_mesh import FULL_DENSITY
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.cuda.graph import Recorded
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import MarchSettings, Rendering, march
from primdiffusion.runtime.failures import PictureOutOfMemory, out_of_memory

ADAM_BETAS = (0.7, 0.9)
"""Adam's decay rates; short averages, because a run is some tens or hundreds of steps."""
WARM_UP = 3
"""Warm-up of the rates, in steps: Adam's first steps have the same length for any gradient."""
LARGEST_CHANGE = 3.0
"""Largest factor by which the side of a box grows or shrinks."""


@dataclasses.dataclass(frozen=True)
class DescentSettings(Checked):
    """Settings of the descent. The rates were tuned on humans in detailed clothes."""

    steps: Count = 150
    """Optimiser steps."""
    views: Count = 2
    """Images per step."""
    stride: Count = 1
    """A step draws every stride-th pixel of every stride-th row, at a random offset: one of its square as many rays."""
    colour_rate: NotNegative = 0.03
    """Learning rate of sRGB-encoded colours in 0 ... 1."""
    density_rate: NotNegative = 0.03
    """Learning rate of densities in units of FULL_DENSITY."""
    scale_rate: NotNegative = 0.09
    """Learning rate of the logarithm of box sizes; 0 keeps them."""
    last_rate: NotNegative = 0.1
    """Fraction of the rates at the end of their cosine decay."""
    largest_density: Annotated[float, Range(1)] = FULL_DENSITY
    """1/m; more gains a tenth of a dB, and exceeds the range of the training set of the diffusion model."""
    grow: bool = True
    """Whether densities may exceed those of the start; one view would grow wisps beside the outlines of others."""
    silhouette: NotNegative = 0.05
    """Weight of the mean square error of the silhouette, relative to that of the colours."""
    pull: NotNegative = 0.0
    """Weight of the squared distance of values from the start, each in its own unit."""
    step: RayStep = 0.01
    """Metres between samples of a ray."""
    seed: int = 0
    """Seed of the order of views and of the offsets."""


def descend(
    start: Payload,
    views: Sequence[PosedView],
    settings: DescentSettings = DescentSettings(),
    on_step: Callable[[], None] = lambda: None,
) -> Payload:
    """Fit a payload to the views, from `start` and on its device; without gradients.

    Deterministic for the same input, settings and device. `on_step` is called after each step; an exception that it
    raises cancels.

    Raises:
        ValueError: the views are not sRGB bytes; the optimisation diverges.
        PictureOutOfMemory: images of this size do not fit into memory.
    """
    if not all(view.rgba.dtype == torch.uint8 for view in views):
        raise ValueError("the views to descend on are not sRGB bytes: encode them")
    start = start.map(lambda values: values.detach().float())
    leaves = _Leaves.of(start)
    first = [leaf.detach().clone() for leaf in leaves]
    groups = zip(leaves, (settings.colour_rate, settings.density_rate, settings.scale_rate), strict=True)
    adams = [(Adam.of([leaf], ADAM_BETAS), rate) for leaf, rate in groups]
    chosen = _chosen(views, settings)
    covered = sum(float(view.rgba[..., 3].sum()) for view in views) / 255 / len(views) / settings.stride**2

    def gradients(*tensors: Tensor) -> tuple[Tensor, ...]:
        own = _Leaves(*(leaf.detach().requires_grad_() for leaf in tensors[:3]))
        shown = [_view(*tensors[first : first + 6]) for first in range(3, len(tensors), 6)]
        with torch.enable_grad():
            payload = own.payload(start)
            loss = torch.stack([_loss(view, payload, settings) for view in shown]).mean() / covered
            if settings.pull:
                far = [(leaf - began).square().sum() for leaf, began in zip(own, first, strict=True)]
                loss = loss + settings.pull * torch.stack(far).sum() / covered
        return loss.detach(), *torch.autograd.grad(loss, own)

    largest = settings.largest_density / FULL_DENSITY
    most = torch.full_like(first[1], largest) if settings.grow else first[1].clamp_max(largest)
    recorded = Recorded(gradients)
    for number in range(1, settings.steps + 1):
        shown = itertools.islice(chosen, settings.views)
        loss, *found = recorded(*leaves, *itertools.chain.from_iterable(map(_tensors, shown)))
        value = float(loss)
        if not math.isfinite(value):
            raise ValueError(f"refinement diverged at step {number} (loss {value}): use smaller rates")
        for (adam, rate), gradient in zip(adams, found, strict=True):
            adam.step([gradient], rate * _share_of_rate(number - 1, settings))
        leaves.clamp_(most)
        on_step()
    return leaves.result(start)


class Adam(NamedTuple):
    """Adam (Kingma and Ba 2015) on some tensors, in place. Unlike `torch.optim.Adam` it does not load the compiler of
    torch, which takes 150 MB and more than a second.
    """

    values: list[Tensor]
    betas: tuple[float, float]
    means: list[Tensor]
    squares: list[Tensor]
    steps: list[Tensor]

    @classmethod
    def of(cls, values: Sequence[Tensor], betas: tuple[float, float]) -> Adam:
        """At its start."""
        means, squares = ([torch.zeros_like(value, requires_grad=False) for value in values] for _ in range(2))
        return cls(list(values), betas, means, squares, [value.new_zeros(()) for value in values])

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], rate: float) -> None:
        """Move the values against their gradients."""
        adam_step(
            self.values, list(gradients), self.means, self.squares, [], self.steps, fused=True, amsgrad=False,
            beta1=self.betas[0], beta2=self.betas[1], lr=rate, weight_decay=0.0, eps=1e-8, maximize=False,
        )  # fmt: skip


class _Leaves(NamedTuple):
    """The optimised tensors."""

    colour: Tensor
    """sRGB-encoded."""
    density: Tensor
    """Densities in units of FULL_DENSITY."""
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
    def clamp_(self, most: Tensor) -> None:
        """Clamp to valid values, after the step: clamping in the forward pass would stop the gradient at the bounds."""
        self.colour.clamp_(0, 1)
        torch.minimum(self.density.clamp_(0), most, out=self.density)
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


def _chosen(views: Sequence[PosedView], settings: DescentSettings) -> Iterator[PosedView]:
    """Shuffled views without end, epoch by epoch, each at a random offset of the stride."""
    draws, stride = np.random.default_rng(settings.seed), settings.stride
    while True:
        for number in draws.permutation(len(views)):
            view = views[number]
            left, top = draws.integers(stride, size=2).tolist()
            yield PosedView(view.frames, view.camera.every(stride, left, top), view.rgba[top::stride, left::stride])


def _tensors(view: PosedView) -> tuple[Tensor, ...]:
    return *vars(view.frames).values(), view.camera.intrinsics, view.camera.world_to_camera, view.rgba


def _view(
    position: Tensor, rotation: Tensor, half_extent: Tensor, intrinsics: Tensor, world_to_camera: Tensor, rgba: Tensor
) -> PosedView:
    """The view of these `_tensors`."""
    height, width = rgba.shape[:2]
    camera = Camera(intrinsics, world_to_camera, width, height)
    return PosedView(Frames(position, rotation, half_extent), camera, rgba)


def _share_of_rate(done: int, settings: DescentSettings) -> float:
    fall = 0.5 + 0.5 * math.cos(math.pi * min(done / settings.steps, 1))
    return min(1, (done + 1) / WARM_UP) * (settings.last_rate + (1 - settings.last_rate) * fall)


def _loss(view: PosedView, payload: Payload, settings: DescentSettings) -> Tensor:
    """L_rgb + silhouette * L_sil, summed over pixels; L_rgb is the mean over channels."""
    rendering = render_view(view, payload, settings.step)
    target = view.rgba.float() / 255
    colour = (encode_srgb(rendering.rgb) - target[..., :3]).square().mean(-1)
    return (colour + settings.silhouette * (rendering.alpha - target[..., 3]).square()).sum()


def render_view(view: PosedView, payload: Payload, step: float) -> Rendering:
    """Render the payload for the view's camera. Raises PictureOutOfMemory."""
    try:
        return march(Primitives.place(view.frames, payload), view.camera, MarchSettings(step=step))
    except (MemoryError, RuntimeError) as e:
        if out_of_memory(e):
            raise PictureOutOfMemory(view.camera.width, view.camera.height) from e
        raise
