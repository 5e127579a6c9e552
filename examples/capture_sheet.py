"""A contact sheet of captures with skeletons drawn on every other view, to check images, cameras and poses.

python examples/capture_sheet.py captures --out sheet.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw
from primdiffusion.body.model import default_body
from primdiffusion.capture.reader import Captures, Subject, joints_of, open_captures
from primdiffusion.formats.camera_rig import View

BONE, JOINT = (255, 255, 255), (255, 64, 64)


def draw_sheet(captures: Captures, out: Path, rows: int, columns: int, size: int) -> None:
    """Write the sheet, one subject in one pose per row; rows cycle through the poses."""
    lines = []
    for name, frame in _chosen(captures, rows):
        subject = captures.subject(name)
        joints = joints_of(subject)[frame]
        cameras = _evenly(len(subject.views), columns)
        lines.append([_thumbnail(subject, frame, camera, size) for camera in cameras])
        for camera, picture in list(zip(cameras, lines[-1], strict=True))[1::2]:
            _draw_joints(picture, subject.views[camera], joints)
    widths = max(sum(picture.width for picture in line) for line in lines)
    sheet = Image.new("RGB", (widths, size * len(lines)))
    for row, line in enumerate(lines):
        left = 0
        for picture in line:
            sheet.paste(picture, (left, size * row))
            left += picture.width
    sheet.save(out)


def _chosen(captures: Captures, rows: int) -> list[tuple[str, int]]:
    """Subjects and frames for the rows: as many subjects as possible, each in the next pose."""
    names = [captures.subjects[i] for i in _evenly(len(captures.subjects), rows)]
    frames = {name: captures.subject(name).frames for name in names}
    turns = [
        (name, (turn + place) % frames[name])
        for turn in range(max(frames.values()))
        for place, name in enumerate(names)
        if turn < frames[name]
    ]
    return sorted(turns[:rows])


def _thumbnail(subject: Subject, frame: int, camera: int, size: int) -> Image.Image:
    picture = Image.fromarray(subject.picture("img", frame, camera))
    width = max(1, round(picture.width * size / picture.height))
    return picture.resize((width, size), Image.Resampling.BOX)


def _draw_joints(picture: Image.Image, view: View, joints: Float[np.ndarray, "J 3"]) -> None:
    pixels, depth = view.project(joints)
    scale = picture.height / view.height
    draw = ImageDraw.Draw(picture)
    places = [tuple(pixel * scale) for pixel in pixels]
    for joint, parent in enumerate(default_body().parents.tolist()):
        if parent >= 0 and min(depth[joint], depth[parent]) > 0:
            draw.line([places[parent], places[joint]], fill=BONE)
    radius = max(picture.height / 160, 1)
    for (x, y), z in zip(places, depth, strict=True):
        if z > 0:
            draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=JOINT)


def _evenly(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` indices, evenly spaced, including the first."""
    return sorted({int(i * count / min(wanted, count)) for i in range(min(wanted, count))})


def main() -> None:
    """Draw the sheet of the captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, help="folder of a capture dataset")
    parser.add_argument("--out", type=Path, default=Path("sheet.png"))
    parser.add_argument("--rows", type=int, default=8, help="subjects, each in the next pose")
    parser.add_argument("--columns", type=int, default=12, help="cameras, evenly spaced")
    parser.add_argument("--size", type=int, default=160, help="height of an image on the sheet, pixels")
    arguments = parser.parse_args()
    draw_sheet(open_captures(arguments.captures), arguments.out, arguments.rows, arguments.columns, arguments.size)


if __name__ == "__main__":
    main()
