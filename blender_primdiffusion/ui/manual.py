"""The manual, which comes with the extension: a button in panels, F1 on whatever is ours, no network."""

from __future__ import annotations

from pathlib import Path

import bpy

MISSING = "the manual's page {!r} is not there: install the extension's zip again"
_FOLDERS = (("manual", ".html"), ("../docs/manual", ".md"))
"""Where pages may be, from the extension's folder: in an installed zip, in a checkout."""


class PRIMDIFFUSION_OT_open_manual(bpy.types.Operator):
    """Open the manual page in the browser; needs no network"""

    bl_idname = "primdiffusion.open_manual"
    bl_label = "Open Manual"
    bl_options: set[str] = set()

    page: bpy.props.StringProperty(name="Page", description="Name of the page, such as first_human", default="index")
    anchor: bpy.props.StringProperty(name="Section", description="Heading on the page; empty: its start")

    def execute(self, _context: bpy.types.Context) -> set[str]:
        import webbrowser  # slow to import, and not needed to register

        path = page_file(self.page) or page_file("index")
        if path is None:
            self.report({"ERROR"}, MISSING.format(self.page))
            return {"CANCELLED"}
        if not webbrowser.open(path.as_uri() + (f"#{self.anchor}" if self.anchor else "")):
            self.report({"ERROR"}, f"no browser could be started: open {path} by hand")
            return {"CANCELLED"}
        return {"FINISHED"}


def draw_manual_button(layout: bpy.types.UILayout, page: str, anchor: str = "") -> None:
    """A question mark that opens a page; for a panel's `draw_header_preset`."""
    props = layout.operator("primdiffusion.open_manual", text="", icon="QUESTION", emboss=False)
    props.page, props.anchor = page, anchor


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
