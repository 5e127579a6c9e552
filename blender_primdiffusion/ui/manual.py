"""The manual, which comes with the extension: a button in panels, F1 on whatever is ours, no network."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy

_FOLDERS = (("manual", ".html"), ("../docs/manual", ".md"))
"""Where pages may be, from the extension's folder: in an installed zip, in a checkout."""


def draw_manual_button(layout: bpy.types.UILayout, page: str, anchor: str = "") -> None:
    """A question mark that opens a page, for the headers of panels; nothing where the manual is not there."""
    if url := page_url(page, anchor):
        layout.operator("wm.url_open", text="", icon="QUESTION", emboss=False).url = url


@functools.cache
def page_url(page: str, anchor: str = "") -> str:
    """Address of a page, or of a heading on it; empty where there is none."""
    path = page_file(page) or page_file("index")
    return "" if path is None else path.as_uri() + (f"#{anchor}" if anchor else "")


def page_file(page: str) -> Path | None:
    """The file of a page; None where there is none."""
    extension = Path(__file__).resolve().parents[1]
    for folder, ending in _FOLDERS:
        path = (extension / folder / f"{page}{ending}").resolve()
        if path.is_file() and path.stem == page:
            return path
    return None


def manual_map() -> tuple[str, list[tuple[str, str]]]:
    """For Blender's Online Manual (F1, or by the right mouse button): what is ours is on the page `api`."""
    path = page_file("api")
    if path is None:
        return "", []
    operators = [(f"bpy.ops.primdiffusion.{name}", f"{path.name}#{name}") for name in dir(bpy.ops.primdiffusion)]
    longer_first = sorted(operators, key=lambda pair: -len(pair[0]))
    inside = [(f"{pattern}.*", suffix) for pattern, suffix in longer_first]
    groups = [
        (f"bpy.types.{cls.__name__.lower()}*", f"{path.name}#{cls.__name__.lower()}")
        for cls in bpy.types.PropertyGroup.__subclasses__()
        if cls.__name__.startswith("PRIMDIFFUSION_PG_")
    ]
    return f"{path.parent.as_uri()}/", [*longer_first, *inside, *groups, ("bpy.types.primdiffusion_*", path.name)]


def register() -> None:
    """Register the map of the manual's pages."""
    bpy.utils.register_manual_map(manual_map)


def unregister() -> None:
    """Undo `register`."""
    bpy.utils.unregister_manual_map(manual_map)
