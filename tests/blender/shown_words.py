"""Every label and tooltip of the extension, gathered from what is registered and from the source of its panels."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import bpy

_WITHIN_A_ROW = {"PRIMDIFFUSION_PG_captures.shards"}
"""Labels that are words between two numbers: 0 of 4."""
_BLENDERS = frozenset(bpy.types.Operator.bl_rna.properties.keys()) | {"name", "rna_type"}
_FROM_BLENDER = {"filepath", "directory", "files", "check_existing", "filter_glob", "remove_active", "remove_name"}
"""Properties that Blender's own mix-ins bring along, in Blender's words."""


def classes(kind: type) -> list[type]:
    found = [cls for cls in kind.__subclasses__() if cls.__name__.startswith("PRIMDIFFUSION_")]
    return sorted({cls for cls in found if cls.is_registered}, key=lambda cls: cls.__name__)


_WAYS = {"what", "to", "choose", "clear", "delete", "finish", "frame", "like", "repair"}
"""Properties by which one operator does several things."""


def ways(name: str) -> list[dict[str, object]]:
    """Properties for each of the things that an operator does; the first are none."""
    found: list[dict[str, object]] = [{}]
    properties = getattr(bpy.ops.primdiffusion, name).get_rna_type().properties
    for way in sorted(_WAYS & set(properties.keys())):
        prop = properties[way]
        if prop.type == "ENUM":
            found += [{way: item.identifier} for item in prop.enum_items[1:]]
        elif prop.type == "BOOLEAN":
            found.append({way: True})
    return found


def rna(cls: type):
    if issubclass(cls, bpy.types.Operator):
        return getattr(bpy.ops.primdiffusion, cls.bl_idname.partition(".")[2]).get_rna_type()
    return cls.bl_rna


def ours(prop: bpy.types.Property) -> bool:
    return not prop.is_hidden and prop.identifier not in _BLENDERS | _FROM_BLENDER


def properties() -> Iterator[tuple[str, bpy.types.Property]]:
    for kind in (bpy.types.Operator, bpy.types.PropertyGroup, bpy.types.AddonPreferences):
        for cls in classes(kind):
            for prop in filter(ours, rna(cls).properties):
                yield f"{cls.__name__}.{prop.identifier}", prop


def labels() -> Iterator[tuple[str, str]]:
    for kind in (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu):
        for cls in classes(kind):
            yield cls.__name__, cls.bl_label
    for where, prop in properties():
        if prop.type in ("POINTER", "COLLECTION") or where in _WITHIN_A_ROW:
            continue
        yield where, prop.name
        for item in getattr(prop, "enum_items_static", ()):
            yield f"{where}.{item.identifier}", item.name


def tooltips() -> Iterator[tuple[str, str]]:
    for cls in classes(bpy.types.Operator):
        if "INTERNAL" not in cls.bl_options:
            yield cls.__name__, rna(cls).description
    for where, prop in properties():
        if prop.type not in ("POINTER", "COLLECTION"):
            yield where, prop.description


ROOT = Path(__file__).resolve().parents[2] / "blender_primdiffusion"
FOR_CONSOLES = ("ui/batch", "capture/command.py", "console.py")
"""Command lines and bug reports stay English."""
_TRANSLATING = {"pgettext_iface", "pgettext_tip", "row_unless"}
_SHOWN_KEYWORDS = {"text", "heading", "message", "title"}


def said_by_blender() -> set[str]:
    """What Blender itself looks up: labels, tooltips, choices; constant words in panels."""
    known = {cls.bl_category for cls in classes(bpy.types.Panel) if hasattr(cls, "bl_category")}
    known |= {label for _, label in labels()} | {text.strip() for _, text in tooltips()}
    for _, prop in properties():
        known |= {item.description for item in getattr(prop, "enum_items_static", ())}
    for _, prop in filter(lambda pair: ours(pair[1]), properties()):
        group = prop.type == "COLLECTION" or (prop.type == "POINTER" and "_PG_" in prop.fixed_type.identifier)
        known |= set() if group else {prop.name, prop.description}
    gain = bpy.types.Collection.bl_rna.properties["primdiffusion_density_gain"]
    known |= {gain.name, gain.description}
    known |= set(_constants_in_panels())
    return {text for text in known if any(letter.isalpha() for letter in text)}


def _constants_in_panels() -> Iterator[str]:
    """Strings given as `text=` and the like, or translated; both branches of a condition."""
    for path in sorted(ROOT.rglob("*.py")):
        if path.relative_to(ROOT).as_posix().startswith(FOR_CONSOLES):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                if getattr(node.func, "id", "") in _TRANSLATING:
                    yield from (text for argument in node.args for text in _strings(argument))
                for keyword in node.keywords:
                    if keyword.arg in _SHOWN_KEYWORDS:
                        yield from _strings(keyword.value)


def _strings(expression: ast.expr) -> Iterator[str]:
    if isinstance(expression, ast.Constant) and isinstance(expression.value, str):
        yield expression.value
    elif isinstance(expression, ast.IfExp):
        yield from _strings(expression.body)
        yield from _strings(expression.orelse)
    elif isinstance(expression, ast.BoolOp):
        for value in expression.values:
            yield from _strings(value)
