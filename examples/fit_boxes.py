"""Fit the boxes of a human to pictures, by gradients of the marcher and by a linear solve, and plot both against time.

python examples/fit_boxes.py --out fitted

The pictures are eight views of a generated human. For your own, fill `pictures` with `PosedView`s: frames of the body
in its pose, a camera, and linear colours premultiplied by the mask.
"""

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import primdiffusion as pd
import torch
from matplotlib.figure import Figure
from primdiffusion.human import frames_of
from primdiffusion.primitives.from_mesh import FULL_DENSITY
from primdiffusion.primitives.primitives import Payload
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import InverseSettings, fit_payload
from primdiffusion.training.refine import bare_body
from torch import Tensor

VIEWS = 8


def main() -> None:
    """Writes the last picture of both fits, and the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--steps", type=int, default=100, help="gradient steps")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    human = pd.generate(pd.load_checkpoint(arguments.checkpoint), seed=7)
    boxes, frames = pd.place(human), frames_of(human)
    cameras = [pd.framing(boxes, 360 * turn / VIEWS, arguments.size, arguments.size) for turn in range(VIEWS)]
    pictures = [PosedView(frames, camera, rgba(boxes, camera)) for camera in cameras]

    start = bare_body(human.betas).payload
    fits = {
        "gradients": list(by_gradients(start, pictures, arguments.steps)),
        "linear solve": list(by_linear_solve(start, pictures)),
    }
    figure = Figure()
    axes = figure.subplots()
    for name, course in fits.items():
        axes.plot([seconds for seconds, _ in course], [psnr(payload, pictures) for _, payload in course], label=name)
        fitted = pd.march(pd.Primitives.place(frames, course[-1][1]), cameras[0])
        fitted.save(arguments.out / f"{name.replace(' ', '_')}.png")
    axes.set(xlabel="seconds", ylabel="PSNR of the given pictures, dB")
    axes.legend()
    figure.savefig(arguments.out / "fit.png")


def by_gradients(start: Payload, pictures: Sequence[PosedView], steps: int) -> Iterator[tuple[float, Payload]]:
    """Yield seconds and payload every ten steps of Adam, each on two pictures in turn."""
    rgb, share = start.rgb.clone().requires_grad_(), (start.density / FULL_DENSITY).requires_grad_()
    adam, began = torch.optim.Adam([rgb, share], lr=0.03), time.perf_counter()
    for step in range(steps):
        payload = Payload(rgb, share * FULL_DENSITY, start.delta_scale)
        errors = []
        for picture in (pictures[2 * step % len(pictures)], pictures[(2 * step + 5) % len(pictures)]):
            drawn = rgba(pd.Primitives.place(picture.frames, payload), picture.camera)
            errors.append((drawn - picture.rgba).square().mean())
        adam.zero_grad()
        torch.stack(errors).sum().backward()
        adam.step()
        with torch.no_grad():
            rgb.clamp_(0, 1)
            share.clamp_(0, 1)
        if step % 10 == 9 or step == steps - 1:
            yield time.perf_counter() - began, payload.map(lambda tensor: tensor.detach().clone())


def by_linear_solve(start: Payload, pictures: Sequence[PosedView]) -> Iterator[tuple[float, Payload]]:
    """Yield seconds and payload of one, two and three Gauss-Newton steps."""
    for steps in (1, 2, 3):
        began = time.perf_counter()
        payload = fit_payload(start, pictures, FULL_DENSITY, InverseSettings(steps=steps))
        yield time.perf_counter() - began, payload


def rgba(boxes: pd.Primitives, camera: pd.Camera) -> Tensor:
    """The picture of boxes [H, W, 4], linear and premultiplied."""
    drawn = pd.march(boxes, camera)
    return torch.cat([drawn.rgb, drawn.alpha[..., None]], dim=-1)


def psnr(payload: Payload, pictures: Sequence[PosedView]) -> float:
    """Of all pictures together, linear colours and alpha, dB."""
    squares = [
        np.square(rgba(pd.Primitives.place(picture.frames, payload), picture.camera).numpy() - picture.rgba.numpy())
        for picture in pictures
    ]
    return -10 * math.log10(np.mean(squares))


if __name__ == "__main__":
    main()
