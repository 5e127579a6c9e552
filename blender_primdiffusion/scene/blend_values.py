"""Read what a .blend holds as a stranger's: custom properties, and paths of pictures and of scene settings.

Anyone can write anything into a .blend. A value of another type, form or size than the extension stores counts as
missing, so that neither drawing nor saving raises, and no name or path leads out of its folder. Nothing else in the
extension reads these values (`tests/blender/scene/test_blend_values.py`).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, cast

import bpy

from ..files.json_files import parse_json
from ..files.regular_files import is_local_path, printable

LONGEST_TEXT = 1 << 16
"""Characters of a text; the longest is the state of a merged sequence, 20 characters a frame. Panels read texts at each
draw."""
LARGEST_NUMBER = 1e6
_LONGEST_SHOWN = 120
"""Characters of a value in a panel or a message."""


def stored_text(holder: bpy.types.bpy_struct, name: str) -> str | None:
    """A custom property that is text of at most LONGEST_TEXT characters; None for any other."""
    value = holder.get(name)
    return value if isinstance(value, str) and len(value) <= LONGEST_TEXT else None


def stored_image(holder: bpy.types.bpy_struct, name: str, largest: int) -> bpy.types.Image | None:
    """A custom property that is an image with a packed file of at most `largest` bytes; None for any other."""
    image = holder.get(name)
    packed = image.packed_file if isinstance(image, bpy.types.Image) else None
    return image if packed is not None and packed.size <= largest else None


def stored_record(holder: bpy.types.bpy_struct, name: str) -> dict[str, Any]:
    """A custom property that is a JSON object; empty for any other."""
    text = stored_text(holder, name)
    return {} if text is None else dict(_record(text))


def stored_numbers(holder: bpy.types.bpy_struct, name: str, count: int) -> list[float] | None:
    """A custom property that is `count` numbers; None for any other."""
    return as_numbers(holder.get(name), count)


def stored_flag(holder: bpy.types.bpy_struct, name: str, default: bool) -> bool:
    """A custom property that is true or false; `default` for any other."""
    value = holder.get(name)
    return bool(value) if isinstance(value, bool | int) else default


def stored_choice(holder: bpy.types.bpy_struct, name: str, choices: Sequence[str]) -> str:
    """A custom property that is one of `choices`; the first of them for any other."""
    text = stored_text(holder, name)
    return text if text is not None and text in choices else choices[0]


def as_numbers(values: object, count: int) -> list[float] | None:
    """A list, tuple or array of `count` numbers up to LARGEST_NUMBER as floats; None for anything else."""
    is_array = isinstance(values, list | tuple) or hasattr(values, "typecode")  # Blender's arrays
    numbers: list[Any] = list(cast(Sequence[Any], values)[: count + 1]) if is_array else []
    if len(numbers) != count or not all(map(_is_number, numbers)):
        return None
    return [float(number) for number in numbers]


def as_shown(value: object) -> str:
    """A value for a panel or a message: one short line, in which unprintable characters are question marks."""
    if isinstance(value, dict | list):
        return "..."
    text = value[: _LONGEST_SHOWN + 1] if isinstance(value, str) else f"{value}"
    shown = printable(text)
    return shown if len(shown) <= _LONGEST_SHOWN else f"{shown[:_LONGEST_SHOWN]}..."


def file_path(stored: str, library: bpy.types.Library | None) -> Path | None:
    """The absolute path of a file that a data-block of this .blend, or of `library`, names; None where it is empty,
    relative to a .blend that was never saved, a device, or on another server."""
    path = bpy.path.abspath(stored, library=library)
    return Path(path) if _is_near(path) else None


def setting_path(stored: str, label: str) -> str:
    """A scene's setting that is a path, absolute; empty where it is not set.

    Raises ValueError for what `file_path` rejects. `label`: what the panel calls the setting.
    """
    path = bpy.path.abspath(stored)
    if stored and not _is_near(path):
        raise ValueError(
            f"{label} is {as_shown(stored)!r}, which is not the whole path of a file or folder on this computer: "
            "choose it again"
        )
    return path


def _is_near(path: str) -> bool:
    """Whether a path is of this computer, or of the server from which the user has opened the .blend."""
    share = PureWindowsPath(path).drive.lower() if os.name == "nt" else ""
    is_of_blend = share.startswith("\\\\") and share == PureWindowsPath(bpy.data.filepath).drive.lower()
    return is_local_path(path) or is_of_blend


@functools.lru_cache(maxsize=64)
def _record(text: str) -> dict[str, Any]:
    """Parsed once: panels draw again at each movement of the mouse."""
    try:
        record = parse_json(text)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER  # not NaN
