"""Scenes of whole files: five humans, one deleted and back, humans of another file, copies, exports read back, handles,
and a capture that is cancelled (see `scenes.py`)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import bpy
from panels import show, sidebar, view
from press import Steps, pose, press, wait
from start import FIRST_SEED, SECOND_SEED, armatures, begin, people_file, queue_of, select, with_people
from visible_scene import at_rest

_FIVE = (FIRST_SEED, SECOND_SEED, 11, 21, 31)
_HEIGHT_M = (1.4, 2.4)
"""With an arm raised."""


def five_humans(module: str, python: str) -> Steps:
    """Five humans, one in local view, all through the camera, one deleted, and back by undo."""
    yield from with_people(module, python, *_FIVE)
    yield from sidebar()
    press("view3d.view_all", "EXEC_DEFAULT")
    yield from at_rest(module)
    yield "five_humans"
    select(armatures()[2])
    press("view3d.localview", "EXEC_DEFAULT")
    yield from at_rest(module)
    yield "five_local"
    press("view3d.localview", "EXEC_DEFAULT")
    press("object.select_all", "EXEC_DEFAULT", action="SELECT")
    press("view3d.camera_to_view_selected", "EXEC_DEFAULT")
    press("view3d.view_camera", "EXEC_DEFAULT")
    yield from at_rest(module)
    yield "five_camera"
    select(armatures()[2])
    bpy.ops.ed.undo_push(message="Before")
    press("object.delete", "EXEC_DEFAULT")
    yield 1.0
    expect(module, len(_FIVE) - 1)
    yield from at_rest(module)
    yield "five_deleted"
    window, area = view()
    yield {"point": [area.x + area.width // 2, window.height - area.y - area.height // 2]}
    yield {"key": "ctrl+z"}
    yield 0.5
    yield {"key": "ctrl+z"}
    yield from wait(lambda: len(armatures()) == len(_FIVE), 20)
    expect(module, len(_FIVE))
    yield from at_rest(module)
    yield "five_undone"


def other_files(module: str, python: str) -> Steps:
    """A human appended and one linked from another file, in Blender's factory scene."""
    yield from with_people(module, python, FIRST_SEED)
    source = people_file(module)
    yield from begin(module, python)
    for link in (False, True):
        with bpy.data.libraries.load(str(source), link=link) as (stored, wanted):
            wanted.collections = [name for name in stored.collections if name == "Human"]
        (collection,) = wanted.collections
        bpy.context.scene.collection.children.link(collection)
    yield from at_rest(module)
    yield from sidebar()
    yield "other_files"
    expect(module, 2)


def copies(module: str, python: str) -> Steps:
    """Shift-D and Alt-D; Save As in the same folder, of which the first file is then deleted."""
    yield from with_people(module, python, FIRST_SEED)
    folder = Path(tempfile.mkdtemp(dir=bpy.app.tempdir))
    first, second = folder / "first.blend", folder / "second.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(first))
    yield from sidebar()
    window, area = view()
    humans = import_module(f"{module}.scene.human").humans
    for key, count, aside in (("shift+d", 2, 1.0), ("alt+d", 3, -1.0)):
        select(armatures()[0])
        yield {"point": [area.x + area.width // 2, window.height - area.y - area.height // 2]}
        yield {"key": key}
        yield 0.5
        yield {"key": "Return"}
        yield from wait(lambda count=count: len(humans(bpy.context.scene)) == count, 20)
        bpy.context.view_layer.objects.active.location.x += aside
        expect(module, count)
        yield from at_rest(module)
    press("view3d.view_all", "EXEC_DEFAULT")
    yield from at_rest(module)
    yield "copies"
    bpy.ops.wm.save_as_mainfile(filepath=str(second))
    yield from wait(lambda: not queue_of(module).busy, 300)
    yield 5.0
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    first.unlink()
    bpy.ops.wm.open_mainfile(filepath=str(second), load_ui=False)
    expect(module, 3)
    press("view3d.view_all", "EXEC_DEFAULT")
    yield from at_rest(module)
    yield from sidebar()
    yield "copies_saved_as"


def read_back(module: str, python: str) -> Steps:
    """A waving human as GLB, USD and FBX, each read into an empty scene by Blender's own importer."""
    yield from with_people(module, python, FIRST_SEED)
    pose(bpy.context.active_object, "Waving")
    files = {name: Path(bpy.app.tempdir) / f"waving.{name}" for name in ("glb", "usdc", "fbx")}
    for path in files.values():
        press("primdiffusion.export", "EXEC_DEFAULT", filepath=str(path))
        yield from wait(lambda: not queue_of(module).busy, 300)
    importers: dict[str, Callable[..., object]] = {
        "glb": bpy.ops.import_scene.gltf,
        "usdc": lambda **file: bpy.ops.wm.usd_import(**file),
        "fbx": bpy.ops.import_scene.fbx,
    }
    for kind, path in files.items():
        if kind == "usdc" and not bpy.app.build_options.usd:
            continue  # Debian's Blender
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        yield 1.0
        importers[kind](filepath=str(path))
        bones = [len(obj.data.bones) for obj in bpy.data.objects if obj.type == "ARMATURE"]
        meshes = [obj for obj in bpy.data.objects if obj.type == "MESH" and len(obj.data.polygons) > 1000]
        if not meshes or not bones or bones[0] < 24:
            raise RuntimeError(f"{path.name}: {len(meshes)} meshes, bones {bones}")
        if not _HEIGHT_M[0] < (height := max(obj.dimensions.z for obj in meshes)) < _HEIGHT_M[1]:
            raise RuntimeError(f"{path.name}: the human is {height:.2f} m tall")
        _, area = view()
        area.spaces.active.shading.type = "MATERIAL"
        press("view3d.view_all", "EXEC_DEFAULT")
        yield 4.0
        yield f"read_back_{kind}"


def handles(module: str, python: str) -> Steps:
    """IK handles: added, the pelvis lowered with the feet where they were, baked back."""
    yield from with_people(module, python, FIRST_SEED)
    yield from show("PRIMDIFFUSION_PT_human/pose")
    armature = armatures()[0]
    press("view3d.view_selected", "EXEC_DEFAULT")
    press("primdiffusion.add_handles")
    press("object.mode_set", "EXEC_DEFAULT", mode="POSE")
    yield from at_rest(module)
    yield "handles_added"
    pelvis = armature.pose.bones["pelvis"]
    matrix = pelvis.matrix.copy()
    matrix.translation.z -= 0.2
    pelvis.matrix = matrix
    yield from at_rest(module)
    yield "handles_lowered"
    press("object.mode_set", "EXEC_DEFAULT", mode="OBJECT")
    press("primdiffusion.bake_handles")
    yield from at_rest(module)
    yield "handles_baked"


def cancelled_captures(module: str, python: str) -> Steps:
    """A small capture of an exported human, cancelled in the middle; it continues where it was."""
    yield from with_people(module, python, FIRST_SEED)
    folder = Path(tempfile.mkdtemp(dir=bpy.app.tempdir))
    for name in ("people", "captures"):
        (folder / name).mkdir()
    press("primdiffusion.export", "EXEC_DEFAULT", filepath=str(folder / "people" / "first.glb"))
    yield from wait(lambda: not queue_of(module).busy, 300)
    bpy.context.preferences.addons[module].preferences.captures = True
    yield from show("PRIMDIFFUSION_PT_captures")
    settings = bpy.context.scene.primdiffusion_captures
    settings.people, settings.out = str(folder / "people"), str(folder / "captures")
    settings.width = settings.height = 128
    captures = import_module(f"{module}.ui.captures_panel").captures
    press("primdiffusion.render_captures", "EXEC_DEFAULT")

    def pictures() -> int:
        return len(list((folder / "captures").rglob("*.png")))

    yield from wait(lambda: pictures() > 5 or not captures.busy, 240)
    yield "captures_rendering"
    captures.cancel()
    yield from wait(lambda: not captures.busy, 60)
    before = pictures()
    if captures.busy or not before:
        raise RuntimeError(f"after Cancel: busy {captures.busy}, {before} pictures")
    yield "captures_stopped"
    press("primdiffusion.render_captures", "EXEC_DEFAULT")
    yield from wait(lambda: pictures() > before or not captures.busy, 240)
    if pictures() <= before:
        raise RuntimeError("the capture did not continue")
    captures.cancel()
    yield from wait(lambda: not captures.busy, 60)


def expect(module: str, count: int) -> None:
    """Raise RuntimeError where the scene does not have this number of humans."""
    found = len(import_module(f"{module}.scene.human").humans(bpy.context.scene))
    if found != count:
        raise RuntimeError(f"{found} humans, not {count}")
