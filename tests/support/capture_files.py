"""Whether a folder of captures is whole, by Pillow instead of the programs' own readers."""

import contextlib
from pathlib import Path

from blender_primdiffusion.formats.capture_layout import LIST_FILE, RELEASED_REFERENCE, picture_path, read_about
from PIL import Image


def faults(root: Path) -> list[str]:
    """Pictures that are missing or cannot be decoded, subjects without a mark, temporary files, a wrong list."""
    about = read_about(root)
    subjects = sorted(path.parent for path in root.glob("*/cameras.json") if path.parent.name != RELEASED_REFERENCE)
    found = [str(path) for path in root.rglob(".*")]
    found += [f"{subject} is not finished" for subject in subjects if not (subject / "complete.json").is_file()]
    if (root / LIST_FILE).read_text().split() != [subject.name for subject in subjects]:
        found.append(LIST_FILE)
    for subject in subjects:
        for kind in about["passes"]:
            for camera in range(about["rig"]["count"]):
                for frame in range(about["frames"]):
                    path = picture_path(subject, kind, camera, frame)
                    if not _decodes(path):
                        found.append(str(path))
    return found


def _decodes(path: Path) -> bool:
    if path.suffix == ".exr":  # which Pillow does not read
        return path.is_file()
    with contextlib.suppress(OSError), Image.open(path) as picture:
        picture.load()
        return True
    return False
