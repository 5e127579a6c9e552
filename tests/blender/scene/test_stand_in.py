"""A Blender without the extension shows a human's body and what is missing; with it, this is never seen."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import bpy
import numpy as np
import pytest
from human_files import copy_of
from human_stage import build_posed, named, whole

import blender_primdiffusion
from benchmarks.cycles_preview import setup_cycles_preview
from blender_primdiffusion.scene.human import body_of, parts_of
from blender_primdiffusion.scene.stand_in import STAND_IN
from blender_primdiffusion.scene.volume_nodes import volumes_of

WITHOUT = """
import json, sys
import bpy
blend, how, saved = sys.argv[1:]
if how == "open":
    bpy.ops.wm.open_mainfile(filepath=blend, use_scripts=False)
else:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    operator = bpy.ops.wm.append if how == "append" else bpy.ops.wm.link
    operator(directory=blend + "/Collection/", filename="Anna", instance_collections=how == "instance")
bpy.context.view_layer.update()
shown = {}
for instance in bpy.context.evaluated_depsgraph_get().object_instances:
    obj = instance.object
    if obj.type == "MESH":
        world = [instance.matrix_world @ vertex.co for vertex in obj.data.vertices]
        shown[obj.name] = {"vertices": [list(point) for point in world], "label": obj.show_name,
                           "render": not obj.hide_render}
if saved:
    bpy.ops.wm.save_as_mainfile(filepath=saved)
print("REPORT", json.dumps(shown))
"""


def without(blend, how="open", saved="") -> dict:
    """Meshes that the viewport of a Blender without the extension shows of a .blend."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, str(blend), how, str(saved)], env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    line = next((line for line in done.stdout.splitlines() if line.startswith("REPORT ")), None)
    assert line is not None, done.stdout + done.stderr
    return json.loads(line.removeprefix("REPORT "))


def stand_in(person) -> bpy.types.Object:
    (found,) = [obj for obj in parts_of(person) if STAND_IN in obj]
    return found


def shown() -> list[str]:
    """Objects of a mesh that viewports show here."""
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    return [instance.object.name for instance in graph.object_instances if instance.object.type == "MESH"]


def posed_vertices(person) -> np.ndarray:
    """The body's vertices in the world [V, 3], by its mesh, which is shown for that."""
    body = body_of(person)
    body.hide_viewport = False
    bpy.context.view_layer.update()
    evaluated = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    found = np.array([evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices])
    body.hide_viewport = True
    return found


@pytest.mark.parametrize("how", ["open", "append", "link", "instance"])
def test_without_the_extension_the_body_is_seen_as_posed(person, how):
    body = posed_vertices(person)
    assert shown() == []
    bpy.ops.wm.save_mainfile()
    (name,) = found = without(bpy.data.filepath, how)
    assert name == "Anna_needs_PrimDiffusion"
    assert found[name]["label"]
    assert not found[name]["render"]
    np.testing.assert_allclose(found[name]["vertices"], body, atol=1e-5)


def test_saved_without_the_extension_it_is_hidden_again_with_it(person, tmp_path):
    assert len(without(bpy.data.filepath, saved=tmp_path / "shot.blend")) == 1
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert shown() == []
    assert whole(named())


@pytest.mark.parametrize("how", ["append", "link", "instance"])
def test_with_the_extension_humans_of_other_files_are_without_it(person, how):
    blend = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    operator = bpy.ops.wm.append if how == "append" else bpy.ops.wm.link
    operator(directory=f"{blend}/Collection/", filename="Anna", instance_collections=how == "instance")
    assert shown() == []


def test_it_follows_the_extension_being_disabled_and_enabled(person):
    assert shown() == []
    blender_primdiffusion.unregister()
    assert shown() == ["Anna_needs_PrimDiffusion"]
    blender_primdiffusion.register()
    assert shown() == []


def test_it_stays_hidden_in_undo_redo_and_new_frames(person):
    bpy.ops.ed.undo_push(message="one")
    person.location.x += 1.0
    bpy.ops.ed.undo_push(message="two")
    for step in (bpy.ops.ed.undo, bpy.ops.ed.redo, lambda: bpy.context.scene.frame_set(7)):
        step()
        assert shown() == []
        assert stand_in(named()).hide_viewport
    assert whole(named())


def test_renders_do_not_show_it(person, tmp_path):
    volumes_of(person).hide_render = True
    scene = bpy.context.scene
    setup_cycles_preview(scene, size=16)
    scene.render.filepath = str(tmp_path / "picture.png")
    bpy.ops.render.render(write_still=True)
    assert max(list(bpy.data.images.load(scene.render.filepath).pixels)[3::4]) == 0.0


def test_it_has_the_bodys_shape_and_name_also_in_duplicates(source):
    person = build_posed(source)
    twin = copy_of(person)
    for one in (person, twin):
        assert stand_in(one).data == body_of(one).data
        assert stand_in(one).parent == one
        assert stand_in(one).modifiers["Armature"].object == one
    assert body_of(twin).data != body_of(person).data
    assert stand_in(twin).name == f"{twin.name}_needs_PrimDiffusion"
    body_of(twin).data = stand_in(twin).data = body_of(person).data
    assert bpy.ops.primdiffusion.reshape(human=twin.name, height=1.6) == {"FINISHED"}
    assert stand_in(twin).data == body_of(twin).data != body_of(person).data
    assert shown() == []
