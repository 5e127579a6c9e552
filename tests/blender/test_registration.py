"""Enabling and disabling the extension: what it imports, what it leaves, and people in files without it."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import bpy
import psutil
import pytest
from own_blender import report_of

import blender_primdiffusion
import build_addon

ROOT = Path(__file__).parents[2]
OWNERS = (
    "Scene", "Object", "Collection", "WindowManager", "Armature", "Volume", "Material", "World", "Action", "PoseBone",
    "Mesh", "Screen", "Preferences", "AddonPreferences", "RenderSettings", "ViewLayer", "Camera", "Bone", "Text",
)  # fmt: skip
"""Types of Blender that may get properties of ours."""
CHILD = """
import sys
import bpy
before = set(sys.modules)
import blender_primdiffusion
blender_primdiffusion.register()
print("HAS", *(name for name in set(sys.modules) - before if sys.modules[name] is not None))
"""


HEAVY = {"torch", "scipy", "numba", "ssl", "http.client", "urllib.request", "email", "asyncio", "multiprocessing"}


def test_registering_imports_no_backend_and_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", CHILD], cwd=ROOT, capture_output=True, text=True, check=False)
    line = next((line for line in done.stdout.splitlines() if line.startswith("HAS ")), None)
    assert line is not None, done.stderr
    assert "blender_primdiffusion.ui.setup" in line.split()
    assert not set(line.split()) & {*HEAVY, "primdiffusion"}


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
    """What Blender knows now, of this extension and of others."""
    found = {*_handlers(), *_drawn_into(), *_keymaps()}
    found |= {f"type {name}" for name in dir(bpy.types) if "primdiffusion" in name.lower()}
    found |= {f"operator {name}" for name in dir(bpy.ops.primdiffusion)}
    for owner in OWNERS:
        names = getattr(bpy.types, owner).bl_rna.properties.keys()
        found |= {f"property {owner}.{name}" for name in names if "primdiffusion" in name}
    found |= {f"manual {function.__module__}" for function in bpy.utils._manual_map}
    found |= {f"preview {number}" for number in map(id, getattr(bpy.utils.previews, "_previews", {}).values())}
    found |= {f"thread {thread.name}" for thread in threading.enumerate()}
    found |= {f"child {child.pid}" for child in psutil.Process().children()}
    for handler in bpy.types.FileHandler.__subclasses__():
        if handler.is_registered:
            found.add(f"file handler {handler.__name__}")
    return found


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
    build_human(saved_scene, synthetic.write(tmp_path / "human", 4))
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


def test_disabling_after_blender_has_cleared_handlers_and_timers(empty_scene):
    blender_primdiffusion.register()
    kept = {}
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        if isinstance(functions, list):
            kept[name] = [one for one in functions if not one.__module__.startswith("blender_primdiffusion")]
            functions.clear()
    try:
        blender_primdiffusion.unregister()
    finally:
        for name, functions in kept.items():
            getattr(bpy.app.handlers, name)[:] = functions
    blender_primdiffusion.register()
    blender_primdiffusion.unregister()


LACKING = """
import sys
import bpy, numpy  # numpy first, or it could not be hidden
bpy.utils.expose_bundled_modules()
import OpenImageIO
lacking = sys.argv[1]
for name in [lacking, *(name for name in sys.modules if name.startswith(lacking + "."))]:
    sys.modules[name] = None  # importing it fails
before = set(dir(bpy.types))
import blender_primdiffusion
try:
    blender_primdiffusion.register()
except ImportError as error:
    print("REFUSED", error)
assert set(dir(bpy.types)) == before
"""


@pytest.mark.any_blender
@pytest.mark.parametrize("lacking", ["numpy", "OpenImageIO"])
def test_enabling_it_names_the_package_and_debians_and_registers_nothing(lacking):
    done = subprocess.run(
        [sys.executable, "-c", LACKING, lacking], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    said = next(line for line in done.stdout.splitlines() if line.startswith("REFUSED"))
    assert f"lacks {lacking}" in said
    assert "sudo apt install python3-numpy python3-openvdb python3-openimageio" in said


@pytest.fixture(scope="module")
def archives(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("dist")
    return [build_addon.build(folder), build_addon.build(folder, viewer=True)]


@pytest.mark.any_blender
@pytest.mark.parametrize("order", [1, -1], ids=["viewer second", "viewer first"])
def test_the_second_build_is_rejected_in_a_sentence_and_registers_nothing(archives, order, tmp_path):
    report, done = report_of("installed_both.py", *archives[::order], folder=tmp_path, bare=True)
    first, second = report["first"], report["second"]
    assert report["message"].startswith(f"Error: {first} is enabled")
    assert "\n" not in report["message"].strip()
    assert report["beside"] == [[first], [first], False]
    assert report["after"] == [True, [second], [second]]
    at_exit = done.stdout.partition("REPORT ")[2] + done.stderr.partition("same operators")[2]
    assert done.returncode == 0
    assert "Traceback" not in at_exit, at_exit
