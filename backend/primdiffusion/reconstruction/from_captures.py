"""Reconstruct a captured subject as a `Human`: from several views with the encoder, or from one or more with the prior.

A gradient descent on the views follows both.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.capture.conditioning import CapturedPerson
from primdiffusion.capture.reader import Views
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import EncoderModel, betas_of_frames, frames_of
from primdiffusion.human import Human, default_frames, model_provenance
from primdiffusion.primitives.primitives import Frames, Payload
from primdiffusion.reconstruction.posture_fit import each
from primdiffusion.reconstruction.prior_fit import FIT_STEPS, PriorFit
from primdiffusion.render.descent import DescentSettings, descend
from primdiffusion.render.image import PosedView
from primdiffusion.version import __version__

DESCENT = DescentSettings(steps=28, views=3, step=0.015)
"""Gradient descent from the encoder's human."""
PULLED_DESCENT = DescentSettings(steps=28, views=3, step=0.01, pull=0.04)
"""Gradient descent from the prior's human, whose pull each view after the second outweighs more: without it, a single
view gains 5 dB and the others lose 2. One alone is pulled as little as two, because its densities do not grow."""
DESCENT_SIDE = 256
"""Largest side of the images that its steps draw, pixels: every second pixel of images of 512 pixels."""
HUMAN_STEPS = FIT_STEPS + 1
"""Reports of a human that the prior draws: the steps of its fit and the descent."""


def reconstruct(
    model: EncoderModel | DiffusionModel,
    person: CapturedPerson,
    seed: int | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Human:
    """Reconstruct the subject on the CPU, by an encoder or by the prior of a diffusion model, which takes one view too.

    Deterministic for a model, views, seed and device. With a seed, the prior draws what no view shows from what is
    probable given the views, instead of the most probable. `on_step` is called `steps_of(model)` times; an exception
    that it raises cancels.

        >>> found = pd.reconstruct(model, person)
        >>> found.provenance["reconstructed_from"]
        ['anna.png']

    Raises ValueError if the encoder's output is not finite, or as `PriorFit.of`.
    """
    if isinstance(model, DiffusionModel):
        return next(draw_humans(model, person, (seed,), on_step))
    payload = encode_and_fit(model, person.views, person.betas)
    origin = {**_origin(person), "checkpoint": model.card.get("name", "unnamed"), "version": __version__}
    origin["full_density"] = model.config.full_density
    return Human(payload, betas_of_frames(model.config, person.betas), origin, model.body_setup).to("cpu").validate()


def draw_humans(
    model: DiffusionModel,
    person: CapturedPerson,
    seeds: Sequence[int | None],
    on_step: Callable[[], None] = lambda: None,
) -> Iterator[Human]:
    """Reconstruct a human for each seed, as `reconstruct`; the slow search for outfit and hair runs once."""
    components, views = PriorFit.of(model), person.views
    if views.pose.translation.ndim > 1:
        frames = [default_frames(person.betas, pose) for pose in each(views.pose)]
    else:
        frames = [default_frames(person.betas, views.pose)] * len(views.rgba)
    estimate = components.start(views, frames, on_step)
    for seed in seeds:
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        payload = components.fit(views, frames, estimate, on_step, generator)
        payload = _descended(payload, views, frames, PULLED_DESCENT, components.full_density)
        on_step()
        drawn = {} if seed is None else {"seed": seed}
        yield Human(payload, person.betas, {**_origin(person), **drawn, **model_provenance(model)}).validate()


def _origin(person: CapturedPerson) -> dict[str, Any]:
    of_capture = {} if person.frame is None else {"frame": person.frame, "views": list(person.cameras)}
    return {"reconstructed_from": person.subject, **of_capture}


def steps_of(model: EncoderModel | DiffusionModel) -> int:
    """Number of times that `reconstruct` reports."""
    return 0 if isinstance(model, EncoderModel) else PriorFit.of(model).start_steps + HUMAN_STEPS


def encode_and_fit(model: EncoderModel, views: Views, betas: Float[Tensor, "n"]) -> Payload:
    """The encoder's payload, optimised on its images by a short gradient descent that adds detail.

    Boxes of the released code (`compat`) stay as their network draws them. Images without the subject are ignored.
    """
    payload = model.encode(views, betas)
    frames = frames_of(model.config, betas.cpu(), views.pose.to("cpu"), model.body_setup)[1]
    views, frames = views.to(payload.density.device), frames.to(payload.density.device)
    if model.config.compat == "released":
        return payload
    return _descended(payload, views, [frames] * len(views.rgba), DESCENT, model.config.full_density)


def _descended(
    payload: Payload, views: Views, frames: Sequence[Frames], settings: DescentSettings, full_density: float
) -> Payload:
    """The payload after a descent on the views that show the subject; itself if none does."""
    cameras = [views.camera.map(lambda values, i=i: values[i]) for i in range(len(views.rgba))]
    images = map(PosedView, frames, cameras, views.rgba)
    seen = [image for image in images if _shows(image)]
    if not seen:
        return payload
    stride = math.ceil(max(views.camera.width, views.camera.height) / DESCENT_SIDE)
    together, pull = min(settings.views, len(seen)), settings.pull / max(len(seen), 2)
    settings = dataclasses.replace(
        settings, views=together, stride=stride, pull=pull, largest_density=full_density, grow=len(seen) > 1
    )
    return descend(payload, seen, settings)


def _shows(image: PosedView) -> bool:
    """Whether an image shows the subject, and its camera faces it."""
    depth = image.camera.project(image.frames.position)[1]
    return bool(image.rgba[..., 3].any()) and bool((depth > 0).any())
