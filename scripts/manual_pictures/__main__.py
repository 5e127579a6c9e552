"""Pictures of the manual that Blender renders: people walking, and stills.

    .venv/bin/python -m scripts.manual_pictures walk            # docs/manual/pictures/walking.gif
    .venv/bin/python -m scripts.manual_pictures stills          # engine, Cycles, a group, edits
    .venv/bin/python -m scripts.manual_pictures boxes           # a reshaped person, as in the paper and as here
    .venv/bin/python -m scripts.manual_pictures window SHOTS    # crops of what scripts/window/look.py has seen

Runs in Blender as a Python module, with the extension from this checkout.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "docs" / "manual" / "pictures"


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("walk", "stills", "boxes", "window"))
    parser.add_argument("shots", type=Path, nargs="?", help="folder of the window's pictures")
    parser.add_argument("--out", type=Path, default=PICTURES)
    parser.add_argument("--only", nargs="*", default=[], help="names of stills; none: all")
    asked = parser.parse_args(words)
    asked.out.mkdir(parents=True, exist_ok=True)
    if asked.what == "window":
        if asked.shots is None:
            parser.error("window wants the folder of the window's pictures")
        from .crops import crop_all

        crop_all(asked.shots, asked.out)
        return
    if asked.what == "boxes":
        from .boxes import boxes

        boxes(asked.out / "reshaped_boxes.jpg")
        return
    with tempfile.TemporaryDirectory() as scratch:
        if asked.what == "walk":
            from .walk import walk

            walk(Path(scratch), asked.out / "walking.gif")
        else:
            from .stills import stills

            stills(Path(scratch), asked.out, asked.only)


if __name__ == "__main__":
    main(sys.argv[1:])
