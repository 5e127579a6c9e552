"""Draws the documentation's picture of the encoder: training people, and below them held-out people.

`python benchmarks/encoder_pictures.py --train CAPTURES --heldout CAPTURES --out docs/pictures/encoder.png` draws a row
for each person, not hand-picked: one of the eight views that the encoder was given and its reconstruction; a view and a
pose that it was not given, each beside the captured picture; the novel pose's depth and primitives.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from primdiffusion.capture.conditioning import conditioning_views, default_betas, spread_cameras
from primdiffusion.capture.reader import Captures, open_captures
from primdiffusion.drawing.draw import draw
from primdiffusion.drawing.scene import Scene, ViewSettings
from primdiffusion.encoder.model import EncoderModel, load_encoder
from primdiffusion.evaluation.reconstruction import picture
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import march
from torch import Tensor

VIEWS = 8
SIZE = 512
MARGIN = 0.06
"""Margin on each side of the person, as a share of the cropped square's side."""
COLUMNS = (
    "given view (1 of 8)", "reconstruction", "novel view", "captured", "novel pose", "captured", "depth", "primitives"
)  # fmt: skip
HEADING, NAME = 26, 22
"""Height of the heading row and width of the name column, in pixels."""
INK, PAPER = (235, 235, 235), (0, 0, 0)


def row(model: EncoderModel, captures: Captures, name: str, novel_frame: int) -> Iterator[np.ndarray]:
    """The person's pictures in the order of COLUMNS, each cropped around the person; sRGB bytes."""
    subject, betas = captures.subject(name), default_betas(captures.subject(name))
    given = spread_cameras(subject, 0, VIEWS)
    novel = [camera for camera in range(len(subject.views)) if camera not in given] or list(given)
    shown = (given[0], novel[0], novel[len(novel) // 2])
    views = conditioning_views(captures, name, 0, given, SIZE)
    payload = model.encode(views, betas)
    for number, (frame, camera) in enumerate(zip((0, 0, novel_frame), shown, strict=True)):
        seen = conditioning_views(captures, name, frame, [camera], SIZE)
        primitives = model.place(payload, betas, seen.pose)
        view = seen.camera.map(lambda tensor: tensor[0])
        drawn, target = picture(march(primitives, view)), seen.image[0].float() / 255
        for image in (target, drawn) if number == 0 else (drawn, target):
            yield cropped(image, seen.mask[0])
    for look in ("depth", "boxes"):
        yield cropped(drawn_view(primitives, view, look), seen.mask[0])


def drawn_view(primitives: Primitives, camera: Camera, look: str) -> Tensor:
    """The depth or the primitives, drawn over black, sRGB-encoded."""
    drawn = draw(Scene(primitives, chart=default_anchors().chart), camera, ViewSettings(look))
    return encode_srgb(torch.from_numpy(drawn.combined[..., :3]).clamp(0, 1))


def cropped(image: Tensor, mask: Tensor) -> np.ndarray:
    """The square around the person, as bytes; black outside the picture."""
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    middle = [(int(hits[0]) + int(hits[-1])) / 2 for hits in (rows, columns)]
    longest = max(int(rows[-1] - rows[0]), int(columns[-1] - columns[0])) + 1
    side = round(longest / (1 - 2 * MARGIN))
    top, left = (round(centre - side / 2) for centre in middle)
    padded = torch.nn.functional.pad(image, (0, 0, side, side, side, side))[
        top + side : top + 2 * side, left + side : left + 2 * side
    ]
    return (padded.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def sheet(rows: list[tuple[str, list[np.ndarray]]], cell: int) -> Image.Image:
    """The rows one below the other, with column headings and row names."""
    whole = Image.new("RGB", (NAME + cell * len(COLUMNS), HEADING + cell * len(rows)), PAPER)
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(14)
    for number, title in enumerate(COLUMNS):
        pen.text((NAME + (number + 0.5) * cell, HEADING / 2), title, INK, font, anchor="mm")
    for number, (title, pictures) in enumerate(rows):
        label = Image.new("RGB", (cell, NAME), PAPER)
        ImageDraw.Draw(label).text((cell / 2, NAME / 2), title, INK, font, anchor="mm")
        whole.paste(label.rotate(90, expand=True), (0, HEADING + number * cell))
        for column, pixels in enumerate(pictures):
            small = Image.fromarray(pixels).resize((cell, cell), Image.Resampling.LANCZOS)
            whole.paste(small, (NAME + column * cell, HEADING + number * cell))
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=Path, help="captures of training people")
    parser.add_argument("--heldout", type=Path, help="captures of held-out people")
    parser.add_argument("--checkpoint", type=Path, help="without it, the package's encoder")
    parser.add_argument("--people", type=int, default=3, help="number of people from each set, evenly spaced")
    parser.add_argument("--cell", type=int, default=224, help="side of a picture in pixels")
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    arguments = parser.parse_args()
    model = load_encoder(arguments.checkpoint)
    rows = []
    for title, root in (("trained on", arguments.train), ("held out", arguments.heldout)):
        if root is None:
            continue
        captures = open_captures(root)
        count = min(arguments.people, len(captures.subjects))
        for number in range(count):
            name = captures.subjects[number * len(captures.subjects) // count]
            last = captures.subject(name).frames - 1
            novel_frame = 1 + number % last if last else 0
            rows.append((title, list(row(model, captures, name, novel_frame))))
    if not rows:
        parser.error("give captures with --train or --heldout")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    sheet(rows, arguments.cell).save(arguments.out, optimize=True)
    print(arguments.out)


if __name__ == "__main__":
    main()
