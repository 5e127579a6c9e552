"""People over a picture of Cycles', the documented way: a linked scene with holdouts, put on top by Alpha Over."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from engine_stage import add_human, cube, material, pixels, render_exr, set_up_render

from blender_primdiffusion.scene.volume_nodes import volumes_of

SIDE = 96
BEFORE, BEHIND, TORSO = (37, 48), (37, 60), (44, 43)
"""Pixels (row, column) of the cube before the person, of the one behind that looks out beside it, of bare torso."""


def hold_out(scene, holds: bool) -> None:
    """Whether the cubes of a scene cut holes, as the view layer's collections say."""
    layer = scene.view_layers[0].layer_collection
    if "solids" not in layer.children:
        scene.collection.children.link(bpy.data.collections["solids"])
    layer.children["solids"].holdout = holds


@pytest.fixture
def shot(extension, saved_scene, folder, tmp_path):
    """Two scenes with the same person, a red cube before, a blue one behind: one for Cycles, one for the engine."""
    solid = saved_scene.scene
    person = add_human(folder)
    cube("before", (0.0, -0.6, 1.2), 0.1).data.materials.append(material((0.8, 0.05, 0.05)))
    cube("behind", (0.15, 0.6, 1.2), 0.3).data.materials.append(material((0.05, 0.05, 0.8), "blue"))
    solids = bpy.data.collections.new("solids")
    for name in ("before", "behind"):
        solids.objects.link(bpy.data.objects[name])
        solid.collection.objects.unlink(bpy.data.objects[name])
    solid.collection.children.link(solids)
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))
    lamp.rotation_euler = (0.9, 0, 0.3)
    solid.collection.objects.link(lamp)
    set_up_render(solid, (SIDE, SIDE), (0.0, -4.0, 1.0), (np.pi / 2, 0, 0))
    solid.name, solid.render.engine, solid.render.film_transparent = "Solid", "CYCLES", False
    solid.cycles.samples, solid.cycles.device, solid.cycles.seed = 4, "CPU", 1
    bpy.ops.scene.new(type="LINK_COPY")
    people = bpy.context.scene
    assert people is not solid
    people.render.engine = "PRIMDIFFUSION"
    hold_out(people, True)
    people.render.film_transparent = True
    volumes_of(person).hide_render = True
    return SimpleNamespace(solid=solid, people=people, out=tmp_path / "picture")


def layers(shot, scene) -> tuple[np.ndarray, np.ndarray]:
    """Combined [h, w, 4] and depth [h, w] of one scene by itself."""
    bpy.context.window.scene = scene
    return render_exr(shot.out.with_suffix(".exr"))


def put_together(shot) -> np.ndarray:
    """The solid scene's picture [h, w, 4] with the people's over it, by Blender's compositor."""
    scene = shot.solid
    tree = scene.compositing_node_group = bpy.data.node_groups.new("over", "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    out = tree.nodes.new("NodeGroupOutput")
    over = tree.nodes.new("CompositorNodeAlphaOver")
    pictures = [socket for socket in over.inputs if socket.type == "RGBA"]
    for socket, source in zip(pictures, (shot.solid, shot.people), strict=True):
        render_layers = tree.nodes.new("CompositorNodeRLayers")
        render_layers.scene = source
        tree.links.new(render_layers.outputs["Image"], socket)
    tree.links.new(over.outputs[0], out.inputs[0])
    settings = scene.render.image_settings
    settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGBA"
    scene.render.filepath = str(shot.out.with_name("together.exr"))
    bpy.context.window.scene = scene
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return pixels(shot.out.with_name("together.exr"))


def test_alpha_over_shows_what_stands_before_people_the_people_and_what_is_behind(shot):
    below, _ = layers(shot, shot.solid)
    above, _ = layers(shot, shot.people)
    together = put_together(shot)
    np.testing.assert_allclose(together[..., :3], (above + (1 - above[..., 3:]) * below)[..., :3], atol=2e-3)
    for pixel in (BEFORE, BEHIND):
        assert above[(*pixel, 3)] == 0
    assert above[(*TORSO, 3)] > 0.99
    assert below[BEFORE][0] > 3 * below[BEFORE][2]
    assert below[BEHIND][2] > 3 * below[BEHIND][0]


def test_depth_of_solids_is_cycles_to_a_centimetre(shot):
    for name, turn in (("before", (0.3, 0.2, 0.5)), ("behind", (0.1, 0.4, -0.6))):
        bpy.data.objects[name].rotation_euler = turn
    hold_out(shot.people, False)
    next(obj for obj in shot.people.objects if obj.type == "ARMATURE").hide_render = True
    _, given = layers(shot, shot.people)
    _, cycles = layers(shot, shot.solid)
    both = (given < 1e9) & (cycles < 1e9)
    assert both.mean() > 0.03
    assert ((given < 1e9) != (cycles < 1e9)).mean() < 0.01
    edge = np.zeros_like(both)
    for axis in (0, 1):
        jump = np.abs(np.diff(np.where(both, cycles, 99.0), axis=axis)) > 0.1
        edge |= np.insert(jump, 0, False, axis) | np.append(jump, np.zeros_like(jump.take([0], axis)), axis)
    inside = both & ~edge
    assert inside.sum() > 0.5 * both.sum()
    assert np.abs(given - cycles)[inside].max() < 0.01
