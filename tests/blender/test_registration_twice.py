"""Enabling and disabling the extension, twice, leaves Blender as it was."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import bpy
import psutil

import blender_primdiffusion

_OWNERS = (
    "Scene", "Object", "Collection", "WindowManager", "Armature", "Volume", "Material", "World", "Action", "PoseBone",
    "Mesh", "Screen", "Preferences", "AddonPreferences", "RenderSettings", "ViewLayer", "Camera", "Bone", "Text",
)  # fmt: skip


def _handlers() -> Iterator[str]:
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        if isinstance(functions, list):
            yield from (f"handler {name} {function.__module__}.{function.__qualname__}" for function in functions)


def _drawn_into() -> Iterator[str]:
    """Functions that were appended to Blender's menus, panels and headers."""
    for kind in (bpy.types.Menu, bpy.types.Panel, bpy.types.Header):
        for cls in kind.__subclasses__():
            drawn = getattr(cls.__dict__.get("draw", None), "_draw_funcs", ())
            yield from (f"{cls.__name__} draws {function.__module__}.{function.__qualname__}" for function in drawn)
            engines = () if cls.__name__.startswith("PRIMDIFFUSION_") else getattr(cls, "COMPAT_ENGINES", ())
            yield from (f"{cls.__name__} for {engine}" for engine in engines if "PRIM" in engine)


def _keymaps() -> Iterator[str]:
    configurations = bpy.context.window_manager.keyconfigs
    for configuration in (configurations.addon, configurations.user, configurations.default):
        for keymap in configuration.keymaps if configuration else ():
            yield from (f"key {keymap.name} {item.idname}" for item in keymap.keymap_items if "primdiff" in item.idname)


def traces() -> set[str]:
    """What of ours, or of anybody's, Blender knows now."""
    found = {*_handlers(), *_drawn_into(), *_keymaps()}
    found |= {f"type {name}" for name in dir(bpy.types) if "primdiffusion" in name.lower()}
    found |= {f"operator {name}" for name in dir(bpy.ops.primdiffusion)}
    for owner in _OWNERS:
        names = getattr(bpy.types, owner).bl_rna.properties.keys()
        found |= {f"property {owner}.{name}" for name in names if "primdiffusion" in name}
    found |= {f"manual {function.__module__}" for function in bpy.utils._manual_map}
    found |= {f"preview {number}" for number in map(id, getattr(bpy.utils.previews, "_previews", {}).values())}
    found |= {f"thread {thread.name}" for thread in threading.enumerate()}
    found |= {f"child {child.pid}" for child in psutil.Process().children()}
    for handler in bpy.types.FileHandler.__subclasses__():
        if handler.is_registered:
            found.add(f"file handler {handler.__name__}")
    words = ("Generate Human", "Human", "Captures")
    found |= {f"{language}: {word}" for language in ("de_DE", "fr_FR") for word in words if _translated(word, language)}
    return found


def _translated(word: str, language: str) -> bool:
    view = bpy.context.preferences.view
    before = view.language
    try:
        view.language = language
    except TypeError:  # this Blender has no languages
        return False
    try:
        return bpy.app.translations.pgettext_iface(word) != word
    finally:
        view.language = before


def test_register_and_unregister_twice_leave_no_trace(empty_scene):
    blender_primdiffusion.register()  # what only the first import brings: modules, and Blender's own caches
    blender_primdiffusion.unregister()
    before = traces()
    assert not [trace for trace in before if "primdiffusion" in trace.lower()]
    for _ in range(2):
        blender_primdiffusion.register()
        during = traces()
        assert {"operator generate", "type PRIMDIFFUSION_PT_generate", "property Scene.primdiffusion"} <= during
        blender_primdiffusion.unregister()
        assert traces() == before


def test_people_survive_the_extensions_absence(saved_scene, tmp_path):
    import synthetic

    from blender_primdiffusion.scene.build import build_human
    from blender_primdiffusion.scene.human import humans

    blender_primdiffusion.register()
    build_human(saved_scene, synthetic.write(tmp_path / "human.npz", 4))
    bpy.context.scene.primdiffusion.seed = 41
    bpy.ops.wm.save_mainfile()
    blender_primdiffusion.unregister()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.ops.wm.save_mainfile()
    blender_primdiffusion.register()
    try:
        bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
        assert len(humans(bpy.context.scene)) == 1
        assert bpy.context.scene.primdiffusion.seed == 41
    finally:
        blender_primdiffusion.unregister()
