"""Draws the documentation's picture of editing: the regions of the body, and people before and after each edit.

`python benchmarks/editing.py --out docs/pictures/editing.png` generates the people of successive seeds, not
hand-picked, and edits them with the default checkpoint (or `--checkpoint`); `--json` saves the seconds of each kind of
edit. `--quick` takes few steps.
"""

from __future__ import annotations

import colorsys
import dataclasses
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing.inpaint import harmonise, inpaint
from primdiffusion.editing.interpolate import interpolate
from primdiffusion.editing.regions import DISJOINT, region_of
from primdiffusion.editing.transfer import transfer_garment, transfer_texture
from primdiffusion.editing.vary import vary
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import PARTS, Sampling
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.human import Human, framing, generate, place
from primdiffusion.render.march import march
from primdiffusion.runtime.device import best_device
from record import command_line, report

COLUMNS = 6
ARMS_LOWERED = 1.05
"""Radians from the T pose, so that pictures are narrow."""
BACKGROUND = (0.72, 0.72, 0.72)
INK, PAPER = (20, 20, 20), (255, 255, 255)
HEADING, LABEL = 24, 18
"""Heights in pixels of a row's heading and of a picture's caption."""
GARMENTS = ("top", "bottom", "shoes", "hair", "skin")

Captioned = tuple[str, Human] | tuple[str, Human, float]
"""A picture's caption, the person on it, and the yaw of the camera in degrees."""


class Studio:
    """Generates and edits people with one model, and records the seconds of each kind of edit."""

    def __init__(self, model: DiffusionModel, steps: int) -> None:
        self.model, self.steps = model, steps
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.people = [generate(model, seed, steps) for seed in range(4)]

    def timed(self, name: str, edit: Callable[[], Human]) -> Human:
        began = time.perf_counter()
        edited = edit()
        self.seconds[f"{name}_seconds"].append(time.perf_counter() - began)
        return edited

    def parts(self) -> Iterator[Captioned]:
        """Which primitives belong to which part of the body."""
        person = self.people[0]
        yield "person", person
        painted = in_colours(person, DISJOINT)
        for name, yaw in (("parts, front", 0.0), ("left side", 90.0), ("back", 180.0)):
            yield name, painted, yaw
        unions = in_colours(person, GARMENTS)
        for name, yaw in ((", ".join(GARMENTS[:3]), 0.0), (", ".join(GARMENTS[3:]), 180.0)):
            yield name, unions, yaw

    def varied(self) -> Iterator[Captioned]:
        """Variants at growing distances."""
        person = self.people[1]
        yield "before", person
        for amount in (0.2, 0.4, 0.6, 0.8, 1.0):
            varied = self.timed("vary", lambda amount=amount: vary(self.model, person, amount, 0, self.steps))
            yield f"amount {amount}", varied

    def inpainted(self) -> Iterator[Captioned]:
        person = self.people[0]
        yield "before", person
        for parts, seed in (
            (("top", "hips"), 0),
            (("top", "hips"), 1),
            (("bottom",), 0),
            (("shoes",), 0),
            (("head",), 0),
        ):
            yield f"{' and '.join(parts)}, seed {seed}", self._inpainted(person, parts, seed)

    def dressed(self) -> Iterator[Captioned]:
        """Clothes regenerated with the attributes given, if the model knows outfits."""
        person = self.people[3]
        outfits = self.model.vocabulary.categories.get("outfit", ())
        if outfits:
            yield "before", person
        for outfit in outfits[:: max(1, len(outfits) // (COLUMNS - 1))][: COLUMNS - 1]:
            yield outfit, self._inpainted(person, ("clothes",), 0, {"outfit": outfit})

    def _inpainted(
        self, person: Human, parts: tuple[str, ...], seed: int, attributes: dict[str, str | float] | None = None
    ) -> Human:
        region = region_of(parts)
        return self.timed("inpaint", lambda: inpaint(self.model, person, region, seed, self.steps, attributes or {}))

    def transferred(self) -> Iterator[Captioned]:
        """One person's clothes transferred to another."""
        target, source = self.people[1], self.people[2]
        top = region_of(["top"])
        yield "target", target
        yield "source", source
        yield "texture of the top", self.timed("transfer", lambda: transfer_texture(source, target, top))
        garment = self.timed("transfer", lambda: transfer_garment(source, target, top))
        yield "garment: top", garment
        yield "harmonised 0.3", self._harmonised(garment, top, 0.3)
        yield "texture of all clothes", transfer_texture(source, target, region_of(["clothes"]))

    def harmonised(self) -> Iterator[Captioned]:
        """Another person's head, which does not match the neck and hands at first."""
        target, source = self.people[3], self.people[0]
        region = region_of(["head", "hands"])
        pasted = transfer_garment(source, target, region_of(["head"]))
        yield "before", target
        yield "another's head", pasted
        for amount in (0.2, 0.4, 0.6, 0.8):
            yield f"head, hands: {amount}", self._harmonised(pasted, region, amount)

    def _harmonised(self, person: Human, region: torch.Tensor, amount: float) -> Human:
        return self.timed("harmonise", lambda: harmonise(self.model, person, region, amount, 0, self.steps))

    def interpolated(self) -> Iterator[Captioned]:
        """Steps of the interpolation from one person to another."""
        a, b = self.people[2], self.people[0]
        for number in range(COLUMNS):
            fraction = number / (COLUMNS - 1)
            between = self.timed("interpolate", lambda: interpolate(self.model, a, b, fraction, self.steps))  # noqa: B023
            yield f"fraction {fraction:.1f}", between


def in_colours(human: Human, parts: tuple[str, ...]) -> Human:
    """The person with one hue for each part, at the original brightness."""
    colours = torch.full((len(human.payload.rgb), 3), 0.75)
    for number, name in enumerate(parts):
        hue = 0.382 * number % 1
        colours[region_of([name])] = torch.tensor(colorsys.hsv_to_rgb(hue, 0.75, 0.95 if number % 2 else 0.7))
    brightness = 0.5 + 0.5 * encode_srgb(human.payload.rgb).mean(1, keepdim=True)
    rgb = decode_srgb(colours)[:, :, None, None, None] * brightness
    return dataclasses.replace(human, payload=dataclasses.replace(human.payload, rgb=rgb))


def picture(human: Human, height: int, yaw: float = 0.0) -> np.ndarray:
    """The person with lowered arms, in a picture two thirds as wide as high; sRGB bytes."""
    theta = torch.zeros(24, 3)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        theta[JOINT_NAMES.index(f"{side}_shoulder"), 2] = sign * ARMS_LOWERED
    primitives = place(human, BodyPose.from_axis_angle(theta.flatten()))
    rendering = march(primitives, framing(primitives, yaw, 2 * height // 3, height))
    return (encode_srgb(rendering.over(BACKGROUND)).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def sheet(rows: list[tuple[str, list[tuple[str, np.ndarray]]]], height: int) -> Image.Image:
    """The rows one below the other, each with its heading, and each picture with its caption."""
    width, pitch = 2 * height // 3, HEADING + height + LABEL
    whole = Image.new("RGB", (COLUMNS * width, len(rows) * pitch), PAPER)
    pen = ImageDraw.Draw(whole)
    for number, (heading, cells) in enumerate(rows):
        top = number * pitch
        pen.text((4, top + HEADING / 2), heading, INK, ImageFont.load_default(15), anchor="lm")
        for column, (label, pixels) in enumerate(cells):
            whole.paste(Image.fromarray(pixels), (column * width, top + HEADING))
            middle = ((column + 0.5) * width, top + HEADING + height + LABEL / 2)
            pen.text(middle, label, INK, ImageFont.load_default(12), anchor="mm")
    return whole


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--checkpoint", type=Path, help="without it, the package's checkpoint")
    parser.add_argument("--height", type=int, default=270, help="pixels of each picture")
    parser.add_argument("--quick", action="store_true", help="3 steps per edit")
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    arguments = parser.parse_args()
    studio = Studio(load_checkpoint(arguments.checkpoint, best_device()), 3 if arguments.quick else Sampling.steps)
    rows = []
    for heading, shown in (
        (f"regions: {len(DISJOINT)} parts without common primitives, {len(PARTS)} names", studio.parts()),
        ("vary", studio.varied()),
        ("inpaint: a region regenerated to fit the rest", studio.inpainted()),
        ("inpaint: clothes regenerated with attributes", studio.dressed()),
        ("transfer", studio.transferred()),
        ("harmonise", studio.harmonised()),
        ("interpolate", studio.interpolated()),
    ):
        cells = [(label, picture(human, arguments.height, *yaw)) for label, human, *yaw in shown]
        if cells:
            rows.append((heading, cells))
    sheet(rows, arguments.height).save(arguments.out, optimize=True)
    report({name: statistics.median(seconds) for name, seconds in studio.seconds.items()}, arguments.json)


if __name__ == "__main__":
    main()
