"""Exports and imports by operators, with a child that has a synthetic person ready."""

import functools
import json
import shutil
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import exporting
import numpy as np
import pytest
import synthetic
from jobs_driven import Layout
from support.errors import refused

from blender_primdiffusion.scene.armature import keyframe_poses
from blender_primdiffusion.scene.human import BETAS, BODY_FILE, humans, proxy_of
from blender_primdiffusion.scene.human_file import read_tensors
from blender_primdiffusion.scene.representation import show_in_viewport
from blender_primdiffusion.scene.volume_nodes import volumes_of
from blender_primdiffusion.ui.export_panel import PRIMDIFFUSION_OT_export

pytestmark = pytest.mark.any_blender

OPERATORS = bpy.ops.primdiffusion


@pytest.fixture
def store(addon, tmp_path, monkeypatch):
    """A folder with a person and its meshes, which the fake child has ready."""
    folder = tmp_path / "store"
    folder.mkdir()
    exporting.write_store(folder)
    monkeypatch.setenv("FAKE_HUMAN", str(folder / "person.human.safetensors"))
    return folder


@pytest.fixture
def anna(store):
    person = exporting.add_person(store)
    show_in_viewport(person, True)
    return person


@pytest.fixture
def out(tmp_path):
    """A folder with a name that programs stumble over."""
    folder = tmp_path / "für später"
    folder.mkdir()
    return folder


def moving(person):
    rng = np.random.default_rng(3)
    turns = synthetic.axis_angle(rng.normal(0, 0.2, (3, 24, 3)))
    keyframe_poses(person, np.arange(1, 4), turns, rng.normal(0, 0.1, (3, 3)))
    bpy.context.scene.frame_end = 3
    return turns


def everything():
    kinds = ("scenes", "objects", "meshes", "materials", "images", "collections", "volumes", "actions")
    return {kind: {obj.name for obj in getattr(bpy.data, kind)} for kind in kinds}


@pytest.mark.parametrize("name", ["a.glb", "b.fbx"])
def test_a_mesh_is_exported_and_nothing_stays_in_the_scene(anna, out, name):
    moving(anna)
    before = everything()
    assert OPERATORS.export(filepath=str(out / name)) == {"FINISHED"}
    assert everything() == before
    assert [path.name for path in out.iterdir()] == [name]


def test_a_failed_export_leaves_neither_file_nor_data(anna, out, monkeypatch):
    before = everything()
    monkeypatch.setenv("FAKE_ORDER", "fails")
    with refused(RuntimeError, "checkpoint"):
        OPERATORS.export(filepath=str(out / "a.glb"))
    assert everything() == before
    assert not list(out.iterdir())


@pytest.mark.parametrize(
    ("operator", "properties", "sentence"),
    [
        ("export", {"filepath": "OUT/a.stl"}, "another ending than .human, .safetensors, .glb, .fbx, .ply"),
        ("import_human", {"filepath": "OUT"}, "is a folder"),
        ("import_motion", {"filepath": "OUT"}, "is a folder"),
        ("export", {"filepath": "OUT/a.glb", "human": "Bert"}, "'Bert' is not in the scene"),
        ("set_representation", {"representation": "MESH"}, "no mesh proxy"),
        ("set_representation", {"representation": "NO_MESH"}, "no mesh proxy"),
        ("add_proxy", {"human": "Bert"}, "'Bert' is not in the scene"),
    ],
)
def test_an_impossible_export_is_reported_in_a_sentence(anna, out, operator, properties, sentence):
    given = {name: v.replace("OUT", str(out)) if isinstance(v, str) else v for name, v in properties.items()}
    with refused(RuntimeError, sentence):
        getattr(OPERATORS, operator)(**given)
    assert not list(out.iterdir())


def test_a_proxy_follows_the_armature_and_is_shown_in_its_place(anna):
    OPERATORS.add_proxy()
    proxy = proxy_of(anna)
    assert proxy.parent == anna
    assert (proxy.hide_viewport, proxy.hide_render) == (False, True)
    assert (volumes_of(anna).hide_viewport, volumes_of(anna).hide_render) == (True, False)
    OPERATORS.set_representation(representation="MESH")
    assert (proxy.hide_render, volumes_of(anna).hide_render) == (False, True)
    OPERATORS.set_representation(representation="MESH_IN_VIEWPORT")
    assert (proxy.hide_render, volumes_of(anna).hide_render) == (True, False)
    OPERATORS.set_representation(representation="VOLUMES")
    assert (proxy.hide_viewport, proxy.hide_render) == (True, True)
    assert not volumes_of(anna).hide_viewport
    assert not volumes_of(anna).hide_render


def test_adding_a_proxy_again_replaces_it_and_removing_takes_all_of_it(anna):
    before = everything()
    OPERATORS.add_proxy()
    once = everything()
    OPERATORS.add_proxy()
    assert {kind: len(names) for kind, names in everything().items()} == {k: len(n) for k, n in once.items()}
    OPERATORS.set_representation(representation="NO_MESH")
    assert everything() == before
    assert not volumes_of(anna).hide_viewport


def test_gaussians_are_requested_in_the_current_pose(anna, out):
    turns = moving(anna)
    bpy.context.scene.frame_set(2)
    anna.location.x = 3.0
    bpy.context.scene.primdiffusion_export.gaussians = 1234
    bpy.context.scene.primdiffusion_export.format = "PLY"
    OPERATORS.export(filepath=str(out / "a"))
    assert [path.name for path in out.iterdir()] == ["a.ply"], "without an extension it is the panel's format"
    asked = json.loads((out / "a.ply").read_text())
    assert asked["limit"] == 1234
    assert np.array(asked["person"]["object"])[0, 3] == pytest.approx(3.0)
    assert np.array(asked["person"]["joints"])[0, :, :3] == pytest.approx(turns[1][0], abs=1e-5)


def test_a_human_file_goes_out_and_comes_back_with_its_shape(anna, store, out):
    shape = np.linspace(-1, 1, 10)
    anna[BETAS] = shape.tolist()
    OPERATORS.export(filepath=str(out / "Anna Müller.human"))
    kept = read_tensors(out / "Anna Müller.human")
    assert set(kept.arrays) == {"rgb", "density", "delta_scale", "betas", "rest_half_extent"}
    assert json.loads(kept.metadata["provenance"]) == json.loads(str(synthetic.arrays(8)["meta"]))
    assert np.frombuffer(kept.arrays["betas"][2], "<f4") == pytest.approx(shape, abs=1e-6)
    with refused(RuntimeError, "body's file"):
        OPERATORS.import_human(filepath=str(out / "Anna Müller.human"))
    shutil.copyfile(store / BODY_FILE, out / BODY_FILE)
    OPERATORS.import_human(filepath=str(out / "Anna Müller.human"))
    other = next(person for person in humans(bpy.context.scene) if person != anna)
    assert other.name == "Anna Müller"
    assert np.array(other[BETAS]) == pytest.approx(shape, abs=1e-6)


def test_a_file_is_imported_at_the_cursor_in_edit_mode_too(store):
    bpy.ops.mesh.primitive_cube_add(location=(9.0, 9.0, 9.0))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.scene.cursor.location = (1.0, 2.0, 0.0)
    OPERATORS.import_human(filepath=str(store / "person.human.safetensors"))
    person = humans(bpy.context.scene)[0]
    assert person.location.xy[:] == pytest.approx((1.0, 2.0))
    assert person.name == "person"
    assert bpy.types.PRIMDIFFUSION_FH_human.bl_import_operator == "primdiffusion.import_human"  # of a dropped file


class Dialog:
    """An export in the file browser, which calls `check` after each change."""

    def __init__(self, **given):
        self.filepath, self.reported = "", []
        self.properties = SimpleNamespace(is_property_set=lambda name: name in given)
        vars(self).update(given)

    def __getattr__(self, name):
        return functools.partial(getattr(PRIMDIFFUSION_OT_export, name), self)


@pytest.mark.parametrize(
    ("format", "before", "after"),
    [
        ("GLB", "/a/Anna.human", "/a/Anna.glb"),
        ("FBX", "/a/Anna.fbx", "/a/Anna.fbx"),
        ("HUMAN", "/a/Anna v1.2", "/a/Anna v1.2.human"),
        ("PLY", "", ""),
    ],
)
def test_another_format_in_the_file_browser_changes_the_extension(anna, format, before, after):
    bpy.context.scene.primdiffusion_export.format = format
    dialog = Dialog()
    dialog.filepath = before
    assert dialog.check(bpy.context) == (before != after)
    assert dialog.filepath == after


def test_the_file_browser_opens_with_the_panels_format_and_shows_its_settings(anna):
    bpy.context.scene.primdiffusion_export.format = "FBX"
    window_manager = MagicMock()
    context = SimpleNamespace(scene=bpy.context.scene, view_layer=bpy.context.view_layer, window_manager=window_manager)
    dialog = Dialog(human="")
    assert dialog.invoke(context, None) == {"RUNNING_MODAL"}
    dialog.layout = Layout()
    dialog.draw(context)
    assert dialog.layout.of("prop") == ["format", "texture_px", "triangles", "animation"]
    assert dialog.filepath == "Anna.fbx"
    window_manager.fileselect_add.assert_called_once()
