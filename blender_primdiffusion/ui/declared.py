"""Blender's properties of fields that `formats.requests` declares: their limits, defaults and descriptions."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path
from typing import Any

import bpy

from ..formats.schema import Range, Slider, descriptions, field_types, split

SKIP = {"SKIP_SAVE"}
_LARGEST = 2**31 - 1
"""Blender's integers are shorter than the backend's."""
_TENSOR_FACTORIES = {int: bpy.props.IntProperty, float: bpy.props.FloatProperty, bool: bpy.props.BoolProperty}
_NAMES = {"auto": "Automatic", "cpu": "CPU", "gpu": "GPU", "hdri": "HDRI"}
"""Labels of choices that are not their values with a capital."""


def declared(record: type, field: str, **changes: Any) -> Any:
    """A property for a number, a flag, a choice or a file of a record, with `changes` to what is declared."""
    kind, marks = split(field_types(record)[field])
    maker = _TENSOR_FACTORIES.get(kind)
    settings: dict[str, Any] = {
        "name": field.replace("_", " ").title(),
        "description": descriptions(record).get(field, "").rstrip("."),
    }
    default = next(each.default for each in dataclasses.fields(record) if each.name == field)
    if default not in (dataclasses.MISSING, None):
        settings["default"] = default
    if typing.get_origin(kind) is typing.Literal:
        maker = bpy.props.EnumProperty
        settings["items"] = [(value, _NAMES.get(value, value.title()), "") for value in typing.get_args(kind)]
    elif kind == Path | None:
        maker = bpy.props.StringProperty
        settings["subtype"] = "FILE_PATH"
    for mark in marks:
        if isinstance(mark, Range):
            settings |= {"min": kind(mark.least), "max": kind(min(mark.most, _LARGEST))}
            if (mark.least, mark.most) == (0, 1):
                settings["subtype"] = "FACTOR"
        elif isinstance(mark, Slider):
            settings |= {"soft_min": kind(mark.least), "soft_max": kind(mark.most)}
    return maker(**settings | changes)
