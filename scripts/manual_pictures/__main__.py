"""Renders the manual's pictures in Blender: walking people, and stills; crops screenshots.

    .venv/bin/python -m scripts.manual_pictures walk            # docs/manual/pictures/walking.gif
    .venv/bin/python -m scripts.manual_pictures stills          # engine, Cycles, a group, edits
    .venv/bin/python -m scripts.manual_pictures boxes           # a reshaped person, as in the paper and as here
    .venv/bin/python -m scripts.manual_pictures window SHOTS    # crops of the screenshots of scripts/window/look.py

Runs in Blender as a Python module, with the extension from this checkout.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "docs" / "manual" / "pictures"


def main(options: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("walk", "stills", "boxes", "window"))
    parser.add_argument("shots", type=Path, nargs="?", help="folder of the screenshots")
    parser.add_argument("--out", type=Path, default=PICTURES)
    parser.add_argument("--only", nargs="*", default=[], help="names of stills; none: all")
    arguments = parser.parse_args(options)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.what == "window":
        if arguments.shots is None:
            parser.error("window needs the folder of the screenshots")
        from .crops import crop_all

        crop_all(arguments.shots, arguments.out)
        return
    if arguments.what == "boxes":
        from .boxes import boxes

        boxes(arguments.out / "reshaped_boxes.jpg")
        return
    with tempfile.TemporaryDirectory() as scratch:
        if arguments.what == "walk":
            from .walk import walk

            walk(Path(scratch), arguments.out / "walking.gif")
        else:
            from .stills import stills

            stills(Path(scratch), arguments.out, arguments.only)


if __name__ == "__main__":
    main(sys.argv[1:])
