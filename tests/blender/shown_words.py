"""Everything that the extension says to people, gathered from what is registered and from its source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import bpy
from test_tooltips import labels, ours, properties, tooltips

ROOT = Path(__file__).resolve().parents[2] / "blender_primdiffusion"
FOR_CONSOLES = ("ui/batch", "capture/command.py", "ui/translations", "ui/jobs/diagnostics.py", "console.py")
"""Words of command lines and bug reports stay English."""
_SAYING = {
    "draw_lines": 1, "draw_text": 1, "report": 1, "poll_message_set": 0, "told": 0, "Remedy": 1, "JobError": 0,
    "error_of": 0,
}  # fmt: skip
"""Functions that say something, and which of their arguments it is."""
_SHOWN_KEYWORDS = {"text", "heading", "message", "title"}


def said_by_blender() -> set[str]:
    """What Blender itself looks up: labels, tooltips, choices; constant words in panels; why buttons are greyed out."""
    known = {label for _, label in labels()} | {text.strip() for _, text in tooltips()}
    for _, prop in properties():
        known |= {item.description for item in getattr(prop, "enum_items_static", ())}
    for _, prop in filter(lambda pair: ours(pair[1]), properties()):
        group = prop.type == "COLLECTION" or (prop.type == "POINTER" and "_PG_" in prop.fixed_type.identifier)
        known |= set() if group else {prop.name, prop.description}
    gain = bpy.types.Collection.bl_rna.properties["primdiffusion_density_gain"]
    known |= {gain.name, gain.description}
    known |= {text for _, text in written(_shown_keywords) if "{}" not in text}
    known |= {text for _, text in written(lambda node: _argument(node, {"poll_message_set": 0}))}
    return {text for text in known if any(letter.isalpha() for letter in text.replace("{}", ""))}


def said_in_sentences() -> dict[str, str]:
    """Templates, {} for each value, with where they stand: errors, reports, news, progress, names of works."""
    found = {}
    for reader in (_raised, lambda node: _argument(node, _SAYING), _shown_keywords):
        found.update({text: where for where, text in written(reader)})
    for where, text in written(_returned):
        if where.startswith(("ui/", "worker/")):
            found[text] = where
    return {text: where for text, where in found.items() if any(x.isalpha() for x in text.replace("{}", ""))}


def written(read) -> Iterator[tuple[str, str]]:
    """File and line, and each string in the expressions that `read` finds."""
    for path in sorted(ROOT.rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        if name.startswith(FOR_CONSOLES):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            for expression in read(node):
                for text in _strings(expression):
                    yield f"{name}:{node.lineno}", text


def _strings(expression: ast.expr) -> Iterator[str]:
    """Of an expression, also of both branches of a condition; values in them are {}. Arguments of calls are data."""
    if isinstance(expression, ast.Constant) and isinstance(expression.value, str):
        yield expression.value
    elif isinstance(expression, ast.JoinedStr):
        yield "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in expression.values)
    elif isinstance(expression, ast.IfExp):
        yield from _strings(expression.body)
        yield from _strings(expression.orelse)
    elif isinstance(expression, ast.BoolOp):
        for value in expression.values:
            yield from _strings(value)
    elif isinstance(expression, ast.Call) and getattr(expression.func, "id", "") in ("told", "sentence"):
        for value in expression.args:
            yield from _strings(value)


def _argument(node: ast.AST, functions: dict[str, int]) -> list[ast.expr]:
    if not isinstance(node, ast.Call):
        return []
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name not in functions:
        return []
    last = len(node.args) if name == "JobError" else functions[name] + 1  # its remedy too
    return node.args[functions[name] : min(last, 2) if name == "JobError" else last]


def _shown_keywords(node: ast.AST) -> list[ast.expr]:
    if not isinstance(node, ast.Call):
        return []
    return [keyword.value for keyword in node.keywords if keyword.arg in _SHOWN_KEYWORDS]


def _raised(node: ast.AST) -> list[ast.expr]:
    if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)):
        return []
    return node.exc.args[:1] if getattr(node.exc.func, "id", "") not in ("SystemExit", "NotImplementedError") else []


def _returned(node: ast.AST) -> list[ast.expr]:
    """Of functions that return a string with a space in it: names of works, news."""
    if not (isinstance(node, ast.FunctionDef) and isinstance(node.returns, ast.Name) and node.returns.id == "str"):
        return []
    values = [child.value for child in ast.walk(node) if isinstance(child, ast.Return) and child.value is not None]
    return [value for value in values if any(" " in text for text in _strings(value))]
