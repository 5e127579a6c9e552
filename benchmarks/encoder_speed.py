"""Times the encoder: reconstructing one person from eight views, and the parts of a training step."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from march import best_ms
from primdiffusion.capture.conditioning import captured_person
from primdiffusion.capture.dataset import batches
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.config import PRESETS
from primdiffusion.encoder.model import EncoderModel, look_up
from primdiffusion.encoder.network import Encoder
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_data import FitSample, fit_dataset
from primdiffusion.training.fit_losses import loss_terms

VIEWS = 8
PARTS = ("data", "forward", "march", "march_backward", "backward", "update")
"""The parts of a step. `march` includes the loss, a small share; `backward` is the network's alone."""


def reconstruct_seconds(model: EncoderModel, captures: Captures, repeats: int) -> dict[str, float]:
    """Seconds from eight 512 x 512 views in memory to a payload: the fastest of several runs, and its parts."""
    person = captured_person(captures.root, captures.subjects[0], 0, VIEWS)

    def whole() -> Payload:
        return model.encode(person.views, person.betas)

    def unproject() -> object:
        return look_up(model.config, person.views, person.betas)

    whole()
    figures = {}
    for name, clock in (("", time.perf_counter), ("processor_", time.process_time)):
        total = best_ms(whole, repeats, clock) / 1e3
        looked_up = best_ms(unproject, repeats, clock) / 1e3
        figures |= {
            f"reconstruct_{name}seconds_cpu": total,
            f"reconstruct_unproject_{name}seconds_cpu": looked_up,
            f"reconstruct_forward_{name}seconds_cpu": max(total - looked_up, 0.0),
        }
    return figures


def step_seconds(captures: Captures, steps: int) -> dict[str, float | int]:
    """Processor seconds of the parts of a training step with the default settings: medians of `steps` steps."""
    config = FitConfig(data=captures.root, run=Path("unused"))
    torch.manual_seed(0)
    encoder = Encoder(PRESETS[config.encoder]).train()
    optimiser = torch.optim.AdamW(encoder.parameters(), config.learning_rate)
    stream = batches(fit_dataset(captures, config), config.batch)
    taken: list[dict[str, float]] = []
    for _ in range(steps + 1):
        seconds: dict[str, float] = {}
        _step(config, encoder, optimiser, lambda: next(stream)[0], seconds)
        taken.append(seconds)
    medians = {part: statistics.median(seconds[part] for seconds in taken[1:]) for part in PARTS}  # first: warm-up
    total = sum(medians.values())
    share = (medians["march"] + medians["march_backward"]) / total
    figures: dict[str, float | int] = {f"step_{part}_processor_seconds": medians[part] for part in PARTS}
    about = {"step_people": config.batch, "step_pictures": config.batch * config.targets, "step_size": config.size}
    return figures | about | {"step_processor_seconds": total, "step_marcher_share": share}


def _step(
    config: FitConfig,
    encoder: Encoder,
    optimiser: torch.optim.Optimizer,
    read: Callable[[], FitSample],
    seconds: dict[str, float],
) -> None:
    """One step, split at the boxes that are marched: the marcher's adjoint is timed separately from the network's."""

    @contextmanager
    def timed(part: str) -> Iterator[None]:
        began = time.process_time()
        yield
        seconds[part] = time.process_time() - began

    with timed("data"):
        sample = read()
    with timed("forward"):
        made = Primitives.place(sample.frames, encoder(sample.found, sample.axis_angle))
    boxes = made.map(lambda tensor: tensor.detach().requires_grad_(tensor.requires_grad))
    with timed("march"):
        people = boxes.map(lambda tensor: tensor[:, None])
        drawn = march(people, sample.target.camera, MarchSettings(step=config.step))
        target, mask = (values.float() / 255 for values in (sample.target.image, sample.target.mask))
        terms = loss_terms(encode_srgb(drawn.rgb), drawn.alpha, boxes.half_extent, target, mask, config.loss)
        total = torch.stack(list(terms.values())).sum()
    with timed("march_backward"):
        total.backward()
    with timed("backward"):
        names = [name for name, tensor in vars(made).items() if tensor.requires_grad]
        torch.autograd.backward([getattr(made, name) for name in names], [getattr(boxes, name).grad for name in names])
    with timed("update"):
        optimiser.step()
        optimiser.zero_grad()
