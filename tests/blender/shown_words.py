"""Every label and tooltip of the extension, gathered from what is registered and from the source of its panels."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import bpy
from test_tooltips import labels, ours, properties, tooltips

ROOT = Path(__file__).resolve().parents[2] / "blender_primdiffusion"
FOR_CONSOLES = ("ui/batch", "capture/command.py", "console.py")
"""Command lines and bug reports stay English."""
_SHOWN_KEYWORDS = {"text", "heading", "message", "title"}


def said_by_blender() -> set[str]:
    """What Blender itself looks up: labels, tooltips, choices; constant words in panels."""
    known = {label for _, label in labels()} | {text.strip() for _, text in tooltips()}
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
    """Strings given as `text=` and the like; both branches of a condition."""
    for path in sorted(ROOT.rglob("*.py")):
        if path.relative_to(ROOT).as_posix().startswith(FOR_CONSOLES):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
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
