"""What the panel Human from Captures asks for; saved with the scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy

from ...formats.requests import CAPTURE_VIEWS

_CAMERAS_FILE = "cameras.json"


def subjects_in(folder: Path) -> list[str]:
    """Names of the people in a dataset of captures; none where the folder is one subject's own, or cannot be read."""
    from ...formats.capture_layout import LIST_FILE

    try:
        if (folder / _CAMERAS_FILE).is_file():
            return []
        if (folder / LIST_FILE).is_file():
            text = (folder / LIST_FILE).read_text(encoding="utf-8", errors="replace")
            return sorted({line.strip() for line in text.splitlines()} - {""})
        return sorted(path.parent.name for path in folder.glob(f"*/{_CAMERAS_FILE}"))
    except OSError:
        return []


def _search(self: PRIMDIFFUSION_PG_reconstruct, _context: bpy.types.Context, typed: str) -> Iterator[str]:
    if self.capture:
        names = subjects_in(Path(bpy.path.abspath(self.capture)))
        yield from (name for name in names if typed.lower() in name.lower())


class PRIMDIFFUSION_PG_reconstruct(bpy.types.PropertyGroup):
    """`scene.primdiffusion_reconstruct`."""

    capture: bpy.props.StringProperty(
        name="Captures",
        description="Folder of a dataset of captures, or of one subject in it",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    subject: bpy.props.StringProperty(
        name="Subject", description="Whom of the dataset; empty where there is only one", search=_search
    )
    frame: bpy.props.IntProperty(
        name="Frame",
        description="Which captured pose to look at; 0 is near the T-pose, where most of a person is seen",
        default=0,
        min=0,
    )
    views: bpy.props.IntProperty(
        name="Views",
        description="How many cameras, spread around the person; all where there are fewer",
        default=CAPTURE_VIEWS,
        min=1,
        soft_max=36,
    )
