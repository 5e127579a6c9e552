"""Heights of the extension's sidebar tabs, as their panels open, without a window.

    python benchmarks/sidebar.py

Draws every panel of the registered extension into a layout that adds up heights by Blender's own style at an interface
scale of 1 (`source/blender/editors/interface`: rows of 20 px, panel headers of 25 px, and the gaps of `uiStyle`).
Compared with screenshots of a 5.2.2 window, tabs are within 3 %. `figures` is for other benchmarks; the command
measures one person who stands in the scene.
"""

from __future__ import annotations

import collections
import functools
import inspect
import sys
import tempfile
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import bpy

ROOT = Path(__file__).resolve().parents[1]
ROW, HEADER = 20, 25
ROOT_SPACE, COLUMN_SPACE, BOX = 5, 2, 5
PANEL_BORDER = 8
"""Above and below the content of an open panel."""
PANEL_GAP = 2
"""Between panels that are in no other panel."""
SEPARATOR = 6
PREFIX = "PRIMDIFFUSION_PT_"


class Button:
    """An operator's button as drawn: its id, its properties, and whether its layout greys it out."""

    def __init__(self, idname: str, layout: Layout):
        self.idname, self.layout, self.properties = idname, layout, types.SimpleNamespace()

    @property
    def grey(self) -> bool:
        layout = self.layout
        while layout is not None:
            if not layout.enabled:
                return True
            layout = layout.parent
        return False


class Layout:
    """Takes the calls of a UILayout and adds up heights in pixels; sections are as they open, or all `opened`."""

    def __init__(
        self,
        parent: Layout | None = None,
        space: float = ROOT_SPACE,
        across: bool = False,
        border: float = 0,
        opened: bool = False,
    ):
        self.parent, self.space, self.across, self.border = parent, space, across, border
        self.opened: bool = parent.opened if parent is not None else opened
        self.items: list[float | Layout] = []
        self.enabled = True
        self.buttons: list[Button] = parent.buttons if parent is not None else []
        self.texts: list[str] = parent.texts if parent is not None else []

    @property
    def height(self) -> float:
        heights = [item.height if isinstance(item, Layout) else item for item in self.items]
        inner = max(heights, default=0) if self.across else sum(heights) + self.space * max(len(heights) - 1, 0)
        return inner + 2 * self.border

    def _inside(self, **how: Any) -> Layout:
        made = Layout(self, **how)
        self.items.append(made)
        return made

    def row(self, **_: Any) -> Layout:
        return self._inside(across=True)

    def split(self, **_: Any) -> Layout:
        return self._inside(across=True)

    def column(self, align: bool = False, **_: Any) -> Layout:
        return self._inside(space=0 if align else COLUMN_SPACE)

    def box(self) -> Layout:
        return self._inside(border=BOX)

    def grid_flow(self, columns: int = 1, align: bool = False, **_: Any) -> Layout:
        return self._inside(space=0 if align else COLUMN_SPACE).grid(columns)

    def grid(self, columns: int) -> Layout:
        return _Grid(self, columns)

    def panel(self, _idname: str, default_closed: bool = False) -> tuple[Layout, Layout | None]:
        header = self._inside(across=True)
        header.items.append(HEADER)
        return header, None if default_closed and not self.opened else self._inside()

    def label(self, text: str = "", **_: Any) -> None:
        self.texts.append(text)
        self.items.append(ROW)

    def prop(self, owner: Any, name: str, text: str | None = None, expand: bool = False, **_: Any) -> None:
        if owner is None:  # the view, without a window
            return self.items.append(ROW)
        found = owner.bl_rna.properties[name]
        self.texts.append(found.name if text is None else text)
        listed = found.type == "ENUM" and (found.is_enum_flag or expand) and not self.across
        self.items.append(ROW * len(found.enum_items) if listed else ROW)

    def operator(self, idname: str, text: str = "", **_: Any) -> types.SimpleNamespace:
        self.texts.append(text)
        self.buttons.append(Button(idname, self))
        self.items.append(ROW)
        return self.buttons[-1].properties

    def operator_menu_enum(self, idname: str, _name: str, text: str = "", **_: Any) -> types.SimpleNamespace:
        return self.operator(idname, text)

    def progress(self, text: str = "", **_: Any) -> None:
        self.label(text)

    def menu(self, _idname: str, text: str = "", **_: Any) -> None:
        self.label(text)

    def prop_search(self, *_: Any, **__: Any) -> None:
        self.items.append(ROW)

    def prop_enum(self, *_: Any, **__: Any) -> None:
        self.items.append(ROW)

    def separator(self, factor: float = 1.0, **_: Any) -> None:
        self.items.append(SEPARATOR * factor)

    def context_pointer_set(self, *_: Any) -> None:
        """Takes no room."""

    def template_icon(self, scale: float = 1.0, **_: Any) -> None:
        self.items.append(ROW * scale)

    def template_action(self, *_: Any, **__: Any) -> None:
        self.items.append(ROW)


class _Grid(Layout):
    """Rows of a number of cells."""

    def __init__(self, parent: Layout, columns: int):
        super().__init__(parent, parent.space)
        self.columns = columns
        parent.items.append(self)

    @property
    def height(self) -> float:
        heights = [item.height if isinstance(item, Layout) else item for item in self.items]
        rows = [max(heights[at : at + self.columns]) for at in range(0, len(heights), self.columns)]
        return sum(rows) + self.space * max(len(rows) - 1, 0)


class _Drawing:
    """Stands for a panel's instance while its class draws."""

    def __init__(self, cls: type, layout: Layout):
        self._cls, self.layout = cls, layout

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._cls, name)
        return functools.partial(found, self) if inspect.isfunction(found) else found


def panels() -> list[type]:
    """The extension's panels in the 3D view's sidebar, in Blender's order: by `bl_order`, then as registered."""
    some = next(
        cls for cls in bpy.types.Panel.__subclasses__() if cls.__name__.startswith(PREFIX) and cls.is_registered
    )
    ui = sys.modules[some.__module__.rpartition(".")[0]]
    ours = [cls for module in ui.MODULES for cls in ui.classes_of(module) if cls.__name__.startswith(PREFIX)]
    sidebar = [cls for cls in ours if issubclass(cls, bpy.types.Panel) and hasattr(cls, "bl_category")]
    return sorted(sidebar, key=lambda cls: getattr(cls, "bl_order", 0))


def draw(cls: type, context: bpy.types.Context, *, opened: bool = False) -> Layout:
    """The content of a panel; `opened` with its closed sections."""
    layout = Layout(opened=opened)
    cls.draw(_Drawing(cls, layout), context)
    return layout


def shown(context: bpy.types.Context, parent: str = "") -> Iterator[type]:
    """Panels in this panel, or in none, whose `poll` shows them now."""
    for cls in panels():
        if getattr(cls, "bl_parent_id", "") == parent and (not hasattr(cls, "poll") or cls.poll(context)):
            yield cls


def is_open(cls: type) -> bool:
    """Whether a panel is open until the user closes it."""
    return "DEFAULT_CLOSED" not in getattr(cls, "bl_options", ())


def open_panels(context: bpy.types.Context, parent: str = "") -> Iterator[type]:
    """Panels whose content is seen as the sidebar opens, in all tabs."""
    for cls in filter(is_open, shown(context, parent)):
        yield cls
        yield from open_panels(context, getattr(cls, "bl_idname", cls.__name__))


def height(cls: type, context: bpy.types.Context) -> float:
    """A panel's pixels, with the panels in it."""
    if not is_open(cls):
        return HEADER
    inner = sum(height(child, context) for child in shown(context, getattr(cls, "bl_idname", cls.__name__)))
    return HEADER + 2 * PANEL_BORDER + draw(cls, context).height + inner


def tabs(context: bpy.types.Context) -> dict[str, float]:
    """Pixels of each tab, by its name."""
    heights: dict[str, float] = {}
    for cls in shown(context):
        heights[cls.bl_category] = heights.get(cls.bl_category, 0) + height(cls, context) + PANEL_GAP
    return heights


def figures(context: bpy.types.Context) -> dict[str, float]:
    """`panels_open`: open panels of the tab that has most; `sidebar_px`: height of the tallest tab; `panel_classes` and
    `operators`: how many the extension has registered, in all editors."""
    most = collections.Counter(cls.bl_category for cls in open_panels(context)).most_common(1)
    return {
        "panels_open": most[0][1],
        "sidebar_px": round(max(tabs(context).values())),
        "panel_classes": registered(bpy.types.Panel),
        "operators": registered(bpy.types.Operator),
    }


def registered(kind: type) -> int:
    """How many classes of the extension of this kind Blender knows."""
    return sum(cls.__name__.startswith("PRIMDIFFUSION_") and cls.is_registered for cls in kind.__subclasses__())


def measured() -> dict[str, float]:
    """The figures with one synthetic human, as after Generate Human; prints the tabs."""
    sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "blender")]
    import synthetic_shape

    import blender_primdiffusion
    from blender_primdiffusion.jobs.queue import JobOutcome, queue
    from blender_primdiffusion.scene import shape
    from blender_primdiffusion.scene.build import build_human
    from blender_primdiffusion.scene.human_file import shape_model_of
    from blender_primdiffusion.ui import generate_panel

    bpy.ops.wm.read_factory_settings(use_empty=True)
    blender_primdiffusion.register()
    generate_panel.draw_set_up = lambda _layout: True
    queue.outcomes["generate"] = JobOutcome(MagicMock(), "Generated in 47.6 s, and after that built in 2.9 s.")
    with tempfile.TemporaryDirectory() as folder:
        person = build_human(bpy.context, synthetic_shape.write(Path(folder) / "human"))
        shape.DEFAULT_BODY_VERTICES = len(shape_model_of(person).template)  # sliders with their names
        for tab, pixels in tabs(bpy.context).items():
            names = [cls.bl_label for cls in open_panels(bpy.context) if cls.bl_category == tab]
            print(f"{tab}: {pixels:.0f} px; open: {', '.join(names)}")
        found = figures(bpy.context)
    blender_primdiffusion.unregister()
    return found


if __name__ == "__main__":
    print(measured())
