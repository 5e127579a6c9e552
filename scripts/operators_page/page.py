"""The text of docs/manual/api.md, from what the extension has registered."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy

INTRODUCTION = Path(__file__).with_name("introduction.md")
_INHERITED = frozenset(bpy.types.Operator.bl_rna.properties.keys()) | {"rna_type"}
_OURS = "PRIMDIFFUSION_"
_OWNERS = (
    ("bpy.context.scene", bpy.types.Scene),
    ("bpy.context.window_manager", bpy.types.WindowManager),
    ("object", bpy.types.Object),
    ("collection", bpy.types.Collection),
)


def page() -> str:
    """The page: a handwritten introduction, then operators and settings, each sorted by name."""
    parts = [INTRODUCTION.read_text(encoding="utf-8").rstrip(), "", "## Operators", ""]
    for operator in sorted(operators(), key=lambda cls: cls.bl_idname):
        parts += _operator(operator)
    parts += ["## Settings", ""]
    for path, group in settings():
        parts += _group(path, group)
    return "\n".join(parts).rstrip() + "\n"


def operators() -> list[type[bpy.types.Operator]]:
    """Our registered operators for users, without internal ones."""
    ours = (cls for cls in bpy.types.Operator.__subclasses__() if cls.__name__.startswith(f"{_OURS}OT_"))
    return [cls for cls in _registered(ours) if "INTERNAL" not in cls.bl_options]


def settings() -> list[tuple[str, type[bpy.types.PropertyGroup]]]:
    """Our setting groups with their paths; nested groups come after the ones that contain them."""
    found: list[tuple[str, type]] = []
    for cls in _registered(c for c in bpy.types.AddonPreferences.__subclasses__() if c.__name__.startswith(_OURS)):
        found.append(("bpy.context.preferences.addons[NAME OF THE EXTENSION].preferences", cls.bl_rna))
    for path, owner in _OWNERS:
        for name in sorted(owner.bl_rna.properties.keys()):
            prop = owner.bl_rna.properties[name]
            if prop.type == "POINTER" and prop.fixed_type.identifier.startswith(_OURS):
                found += _nested(f"{path}.{name}", prop.fixed_type)
    return found


def properties(struct) -> list[bpy.types.Property]:
    """The visible properties that an operator or a group defines itself."""
    return [
        p for p in struct.properties if p.identifier not in _INHERITED and p.identifier != "name" and not p.is_hidden
    ]


def _nested(path: str, struct) -> Iterator[tuple[str, type]]:
    yield path, struct
    for prop in struct.properties:
        if prop.type in ("POINTER", "COLLECTION") and prop.fixed_type.identifier.startswith(_OURS):
            yield from _nested(f"{path}.{prop.identifier}{'[i]' if prop.type == 'COLLECTION' else ''}", prop.fixed_type)


def _registered(classes: Iterable[type]) -> Iterator[type]:
    """Without classes of an earlier registration: only those that Blender has registered now."""
    return (cls for cls in classes if getattr(cls, "is_registered", False))


def _operator(cls: type[bpy.types.Operator]) -> list[str]:
    name = cls.bl_idname.partition(".")[2]
    rna = getattr(bpy.ops.primdiffusion, name).get_rna_type()
    message = _poll_message(cls)
    return [
        f"### {name}",
        "",
        f"**{cls.bl_label}.** {_sentence(rna.description)}",
        *([f"If it is disabled, the tooltip says: {_sentence(message)}"] if message else []),
        "",
        *_table(properties(rna)),
    ]


def _group(path: str, struct) -> list[str]:
    shown = [p for p in properties(struct) if p.type not in ("POINTER", "COLLECTION") or not _is_ours(p)]
    return [f"### {struct.identifier}", "", f"`{path}`", "", *_table(shown)] if shown else []


def _is_ours(prop: bpy.types.Property) -> bool:
    return prop.fixed_type.identifier.startswith(_OURS)


def _table(shown: list[bpy.types.Property]) -> list[str]:
    if not shown:
        return []
    rows = [f"| `{p.identifier}` | {_kind(p)} | {_default(p)} | {_cell(p.description)} |" for p in shown]
    return ["| name | type | default | |", "|---|---|---|---|", *rows, ""]


def _kind(prop: bpy.types.Property) -> str:
    if prop.type in ("INT", "FLOAT"):
        kind = {"INT": "int", "FLOAT": "float"}[prop.type]
        low, high = _bound(prop.hard_min), _bound(prop.hard_max)
        size = f"[{prop.array_length}]" if prop.array_length else ""
        span = f"{low} ... {high}" if low and high else f"{low} or more" if low else f"{high} or less" if high else ""
        return f"{kind}{size}" + (f", {span}" if span else "")
    if prop.type == "ENUM":
        items = [f"`{item.identifier}`" for item in prop.enum_items_static]
        kind = "set of " if prop.is_enum_flag else ""
        return kind + (", ".join(items) if items else "a name; the choices depend on the scene")
    if prop.type in ("POINTER", "COLLECTION"):
        return prop.fixed_type.identifier
    return {"BOOLEAN": "bool", "STRING": "path" if prop.subtype in ("FILE_PATH", "DIR_PATH") else "string"}[prop.type]


def _bound(number: float) -> str:
    return "" if abs(number) >= 2**31 - 1 else f"{number:g}"


def _default(prop: bpy.types.Property) -> str:
    if prop.type in ("POINTER", "COLLECTION"):
        return ""
    if prop.type == "ENUM":
        if not prop.enum_items_static:
            return ""
        chosen = [item.identifier for item in prop.enum_items_static if item.identifier in prop.default_flag]
        return f"`{{{', '.join(map(repr, chosen))}}}`" if prop.is_enum_flag else f"`{prop.default}`"
    if prop.type == "STRING":
        return f"`{prop.default!r}`"
    value = tuple(prop.default_array) if getattr(prop, "array_length", 0) else (prop.default,)
    shown = ", ".join(f"{number:.6g}" if prop.type == "FLOAT" else str(number) for number in value)
    return f"`({shown})`" if len(value) > 1 else f"`{shown}`"


def _poll_message(cls: type[bpy.types.Operator]) -> str:
    """The message that `poll` sets when it disables the operator; empty if the operator has no `poll` of its own."""
    messages: list[str] = []
    poll = getattr(cls, "poll", None)
    if getattr(poll, "__module__", "").startswith("blender_primdiffusion"):
        poll.__func__(SimpleNamespace(poll_message_set=messages.append), bpy.context)
    return messages[0] if messages else ""


def _sentence(text: str) -> str:
    text = re.sub(r"\s+", " ", text).strip().rstrip(".")
    return f"{text}." if text else ""


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|")
