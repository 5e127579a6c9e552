"""Crops the manual's pictures from the screenshots of scripts/window/look.py."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from .shrink import save_jpeg, save_png

PANELS = {
    "sidebar": ("first_sidebar", "first_person"),
    "generate": ("first_denoising", "generate_in_line", "generate_error"),
    "attributes": ("generate_attributes",),
    "variations": ("variations_empty", "variations_denoising", "variations_selected"),
    "shape": ("human_shape_before", "human_shape_after"),
    "details": ("human_details",),
    "edits": ("edit_parts", "edit_two_people"),
    "motion": ("motion_empty", "motion_imported"),
    "render": ("render_cycles", "render_merged", "render_outdated"),
    "captures": ("captures_settings",),
    "export": ("export_before", "export_proxy"),
    "picture": ("picture_chosen", "picture_another_back"),
}
"""Rows of sidebars, cropped to their panels."""
WINDOWS = {
    "preferences_without": ("set_up_preferences", "window 1"),
    "preferences_with": ("set_up_named", "window 1"),
    "window_solid": ("first_solid", "window 0"),
    "window_person": ("first_person", "window 0"),
    "window_redressed": ("edit_redressed", "window 0"),
    "window_painting": ("edit_painting", "window 0"),
    "pose_library": ("human_poses", "view"),
    "window_proxy": ("export_proxy", "window 0"),
    "window_motion": ("motion_imported", "window 0"),
}
"""Whole windows, or a part of the main one (BELOW)."""
STACKS = {"set_up_progress": ("set_up_real_0", "set_up_real_1", "set_up_real_2")}
"""The extension's part of the preferences, one below the other."""
ROWS = {"window_picture": ("picture_posed", "picture_fitted", "picture_posed_made")}
"""Camera's frame of the main window, side by side."""
DIALOGS = {"motion_dialog": "motion_dialog"}
_ABOVE, BELOW = 24, {"window 0": 84, "view": 0}
"""Pixels of the main window that are left out above the 3D view and at its lower edge; "view" has the asset shelf,
below the sidebar. The properties and the timeline are left out too."""
PREFERENCES_PART = (172, 240, 872, 548)
"""Pixels of the preferences' window: the extension's part, down to a whole row."""
ROW_PART = (320, 178, 990, 1078)
"""Pixels of the main window in ROWS."""
_STACKED_ROWS = 130
"""Pixels of the preferences' part: down to the end of the backend's box while a set-up runs."""
_WINDOW_WIDTH = 880
_ROW_SIZE = (335, 450)
_PANEL_WIDTH = 262
_PANEL_RGB, _SECTION_RGB, _COLUMN, _RUN = 74, 67, 8, 10
"""Greys of panels, and of what is in their open sections, at this distance from the sidebar's left edge, over at least
so many rows."""
_GAP, _GAP_RGB = 12, (255, 255, 255)


def crop_all(shots: Path, out: Path) -> None:
    """Crop all screenshots that exist; print the names of missing ones."""
    for name, seen in PANELS.items():
        if _are_there(shots, *seen):
            save_png(_row([panels_of(shots, shot) for shot in seen]), out / f"{name}.png")
    for name, (shot, window) in WINDOWS.items():
        if _are_there(shots, shot):
            picture, boxes = _read(shots, shot)
            if window in BELOW:
                _, _, right, bottom = boxes["view"]
                part = picture.crop((0, _ABOVE, right, bottom - BELOW[window]))
                part.thumbnail((_WINDOW_WIDTH, part.height), Image.Resampling.LANCZOS)
                save_jpeg(part, out / f"{name}.jpg")
            else:
                save_png(_filled(picture.crop(boxes[window]).crop(PREFERENCES_PART)), out / f"{name}.png")
    for name, seen in STACKS.items():
        if _are_there(shots, *seen):
            save_png(_column([_preferences_top(shots, shot) for shot in seen]), out / f"{name}.png")
    for name, seen in ROWS.items():
        if _are_there(shots, *seen):
            parts = [_read(shots, shot)[0].crop(ROW_PART).resize(_ROW_SIZE, Image.Resampling.LANCZOS) for shot in seen]
            save_jpeg(_row(parts), out / f"{name}.jpg")
    for name, shot in DIALOGS.items():
        if _are_there(shots, shot):
            save_png(_changed_part(shots, shot), out / f"{name}.png")


def panels_of(shots: Path, shot: str) -> Image.Image:
    """The sidebar down to the end of its last panel."""
    picture, boxes = _read(shots, shot)
    left, top, _, bottom = boxes["sidebar"]
    column = np.asarray(picture)[top:bottom, left + _COLUMN].astype(int)
    greys = np.abs(column[..., None] - [_PANEL_RGB, _SECTION_RGB]) <= [1, 0]
    runs = np.convolve(greys.all(1).any(1), np.ones(_RUN), "valid") == _RUN
    if not runs.any():
        raise ValueError(f"{shot} shows no panel in its sidebar")
    end = int(np.flatnonzero(runs)[-1]) + _RUN + 2
    return picture.crop((left + 2, top, left + _PANEL_WIDTH, top + end))


def _filled(picture: Image.Image) -> Image.Image:
    """A picture without the rows at its lower edge that are all alike."""
    rows = np.asarray(picture)
    last = np.flatnonzero((rows != rows[-1]).any((1, 2)))[-1]
    return picture.crop((0, 0, picture.width, min(int(last) + _GAP, picture.height)))


def _changed_part(shots: Path, shot: str) -> Image.Image:
    """A dialog: the part of the 3D view that differs from the same window before it."""
    after, boxes = _read(shots, shot)
    before, _ = _read(shots, "motion_empty")
    after, before = (np.asarray(p)[: boxes["sidebar"][3], : boxes["sidebar"][0]] for p in (after, before))
    differ = np.abs(after.astype(int) - before).max(2) > 24
    rows, columns = np.flatnonzero(differ.sum(1) > 40), np.flatnonzero(differ.sum(0) > 40)
    return Image.fromarray(after[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])


def _are_there(shots: Path, *names: str) -> bool:
    missing = [name for name in names if not (shots / f"{name}.png").is_file()]
    if missing:
        print(f"missing screenshots: {', '.join(missing)}")
    return not missing


def _read(shots: Path, name: str) -> tuple[Image.Image, dict[str, list[int]]]:
    where = json.loads((shots / f"{name}.json").read_text(encoding="utf-8"))
    return Image.open(shots / f"{name}.png").convert("RGB"), where


def _row(pictures: list[Image.Image]) -> Image.Image:
    width = sum(picture.width for picture in pictures) + _GAP * (len(pictures) - 1)
    row = Image.new("RGB", (width, max(picture.height for picture in pictures)), _GAP_RGB)
    x = 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width + _GAP
    return row


def _preferences_top(shots: Path, shot: str) -> Image.Image:
    picture, boxes = _read(shots, shot)
    left, top, right, _ = PREFERENCES_PART
    return picture.crop(boxes["window 1"]).crop((left, top, right, top + _STACKED_ROWS))


def _column(pictures: list[Image.Image]) -> Image.Image:
    column = Image.new("RGB", (pictures[0].width, sum(picture.height for picture in pictures)))
    y = 0
    for picture in pictures:
        column.paste(picture, (0, y))
        y += picture.height
    return column
