"""Presets of settings, which Blender writes as Python: their assignments are read, nothing in them is run."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from ..formats.regular_files import read_regular

_LARGEST, _LARGEST_NUMBER = 2**16, 2**31
"""Bytes of a preset, and Blender's largest integer."""
_ROOT = "settings"


def read_preset(path: Path) -> list[tuple[tuple[str, ...], bool | int | float | str]]:
    """The assignments of a preset, such as (("attributes", "height"), 1.7) for `settings.attributes.height = 1.7`.

    Raises ValueError for a file that is no preset, and OSError.
    """
    try:
        tree = ast.parse(read_regular(path, _LARGEST).decode("utf-8"))
        found = list(_assignments(tree))
        if not found:
            raise ValueError("it sets nothing")
        return found
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path.name!r} is no preset ({error!s:.80}): remove it, and add it again") from error


def _assignments(tree: ast.Module) -> Iterator[tuple[tuple[str, ...], bool | int | float | str]]:
    for line in tree.body:
        if isinstance(line, ast.Import) or (isinstance(line, ast.Assign) and _names(line.targets[0]) == (_ROOT,)):
            continue  # what Blender writes at the beginning of each preset
        if not isinstance(line, ast.Assign) or len(line.targets) != 1:
            raise ValueError(f"line {line.lineno} sets nothing")
        root, *names = _names(line.targets[0]) or ("",)
        value = ast.literal_eval(line.value)
        possible = isinstance(value, str) or (isinstance(value, bool | int | float) and abs(value) <= _LARGEST_NUMBER)
        if root != _ROOT or not names or not possible:
            raise ValueError(f"line {line.lineno} sets something else than a setting")
        yield tuple(names), value


def _names(target: ast.expr) -> tuple[str, ...]:
    """("settings", "steps") of `settings.steps`; nothing for other targets."""
    if isinstance(target, ast.Name):
        return (target.id,)
    if isinstance(target, ast.Attribute) and (before := _names(target.value)):
        return (*before, target.attr)
    return ()
