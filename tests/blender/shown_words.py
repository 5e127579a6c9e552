"""Every label and tooltip of the extension, gathered from what is registered."""

from collections.abc import Iterator

import bpy

_WITHIN_A_ROW: set[str] = set()
"""Labels that are words between two numbers: 0 of 4."""
_BLENDERS = frozenset(bpy.types.Operator.bl_rna.properties.keys()) | {"name", "rna_type"}
_FROM_BLENDER = {"filepath", "directory", "files", "check_existing", "filter_glob", "remove_active", "remove_name"}
"""Properties that Blender's own mix-ins bring along, in Blender's words."""


def classes(kind: type) -> list[type]:
    found = [cls for cls in kind.__subclasses__() if cls.__name__.startswith("PRIMDIFFUSION_")]
    return sorted({cls for cls in found if cls.is_registered}, key=lambda cls: cls.__name__)


_WAYS = {"what", "to", "choose", "clear", "delete", "finish", "frame", "like", "repair", "use_seed"}
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
