"""Solid objects in the engine's pictures: which ones, where, in what colours; before, behind and inside a person."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from engine_stage import add_human, cube, material, render_png, set_up_render
from support.errors import refused

from blender_primdiffusion.engine.picture import base_colour, changed_by, scene_solids, stored
from blender_primdiffusion.scene.human import body_of


@pytest.fixture
def stage(extension, saved_scene, tmp_path):
    """A camera at (0, -4, 1) that looks along y; 96 x 96 pixels, transparent."""
    set_up_render(saved_scene.scene, (96, 96), (0.0, -4.0, 1.0), (np.pi / 2, 0, 0))
    return SimpleNamespace(scene=saved_scene.scene, out=tmp_path / "picture.png")


def solids_now():
    return scene_solids(bpy.context.evaluated_depsgraph_get())


def test_a_cubes_triangles_are_in_the_backends_axes(stage):
    cube(centre=(1.0, 2.0, 3.0))
    solids = solids_now()
    assert solids.corners.shape == (12, 3, 3)
    np.testing.assert_allclose(solids.corners.reshape(-1, 3).mean(0), [1.0, 3.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(np.ptp(solids.corners.reshape(-1, 3), 0), [0.4] * 3, atol=1e-6)


def test_colours_are_the_materials_base_colour_or_the_objects_own(stage):
    painted, plain = cube("painted"), cube("plain")
    painted.data.materials.append(material((0.8, 0.1, 0.2)))
    painted.data.materials.append(None)
    painted.color = (0.1, 0.9, 0.1, 1)
    painted.data.polygons[0].material_index = 1
    plain.color = (0.3, 0.4, 0.5, 1)
    colours = solids_now().colour
    rows, repeats = np.unique(np.round(colours.astype(np.float64), 3), axis=0, return_counts=True)
    counts = dict(zip(map(tuple, rows.tolist()), repeats.tolist(), strict=True))
    assert counts == {(0.8, 0.1, 0.2): 10, (0.1, 0.9, 0.1): 2, (0.3, 0.4, 0.5): 12}


def test_a_base_colour_from_other_nodes_gives_way_to_the_one_of_solid_mode(stage):
    textured = material((1, 1, 1))
    textured.diffuse_color = (0.2, 0.3, 0.4, 1)
    tree = textured.node_tree
    noise = tree.nodes.new("ShaderNodeTexNoise")
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    tree.links.new(noise.outputs[0], shader.inputs["Base Color"])
    assert base_colour(textured) == pytest.approx((0.2, 0.3, 0.4))


def test_curves_texts_metaballs_and_instances_count(stage):
    curve = bpy.data.curves.new("curve", "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", 0.1
    spline = curve.splines.new("POLY")
    spline.points.add(1)
    spline.points[1].co = (0, 0, 1, 1)
    text = bpy.data.curves.new("text", "FONT")
    text.body = "A"
    ball = bpy.data.metaballs.new("ball")
    ball.elements.new()
    counts = []
    for data in (curve, text, ball):
        obj = bpy.data.objects.new(data.name, data)
        stage.scene.collection.objects.link(obj)
        counts.append(len(solids_now().corners))
    assert 0 < counts[0] < counts[1] < counts[2]
    group = bpy.data.collections.new("group")
    box = cube("in group")
    stage.scene.collection.objects.unlink(box)
    group.objects.link(box)
    for x in range(3):
        instance = bpy.data.objects.new(f"instance{x}", None)
        instance.instance_type, instance.instance_collection = "COLLECTION", group
        instance.location.x = x
        stage.scene.collection.objects.link(instance)
    assert len(solids_now().corners) == counts[2] + 3 * 12


def test_a_persons_own_body_is_left_out_even_when_shown(stage, folder):
    person = add_human(folder)
    body = body_of(person)
    body.hide_render = body.hide_viewport = False
    assert len(solids_now().corners) == 0


def test_objects_hidden_in_renders_or_from_the_camera_are_not_rendered(stage):
    obj = cube()
    assert render_png(stage.out)[..., 3].any()
    obj.hide_render = True
    assert not render_png(stage.out).any()
    obj.hide_render, obj.visible_camera = False, False
    assert not render_png(stage.out).any()


def test_only_changes_that_affect_solids_make_them_read_again(stage, folder):
    obj = cube()
    seen = []
    handler = lambda _scene, depsgraph: seen.append(changed_by(depsgraph))  # noqa: E731
    bpy.app.handlers.depsgraph_update_post.append(handler)
    try:
        bpy.context.view_layer.update()
        seen.clear()
        for change in (
            lambda: setattr(stage.scene.camera, "location", (0, -3, 1)),
            lambda: setattr(obj, "location", (0.1, 0, 1)),
            lambda: obj.data.vertices[0].co.__setitem__(0, 0.5) or obj.data.update(),
        ):
            change()
            bpy.context.view_layer.update()
    finally:
        bpy.app.handlers.depsgraph_update_post.remove(handler)
    assert seen == [False, True, True]


@pytest.mark.any_blender
def test_the_file_is_named_by_its_content_and_written_once(stage, tmp_path):
    cube()
    path = stored(solids_now(), tmp_path)
    stamp = path.stat().st_mtime_ns
    assert stored(solids_now(), tmp_path) == path
    assert path.stat().st_mtime_ns == stamp
    bpy.data.objects["cube"].location.x = 0.5
    bpy.context.view_layer.update()
    assert stored(solids_now(), tmp_path) != path
    bpy.data.objects["cube"].hide_viewport = True
    bpy.context.view_layer.update()
    assert stored(solids_now(), tmp_path) is None


@pytest.mark.any_blender
def test_a_mesh_with_nan_is_an_error_that_names_the_object(stage):
    cube("broken").data.vertices[0].co.z = float("nan")
    with refused(RuntimeError, "broken", "NaN"):
        render_png(stage.out)


@pytest.fixture
def pair(stage, folder):
    """A person at the origin and a cube at the height of the chest."""
    add_human(folder)
    box = cube(centre=(0.0, 0.0, 1.2), half=0.1)
    box.data.materials.append(material((0.9, 0.02, 0.02)))
    return stage, box


def centre_of(box, picture) -> np.ndarray:
    """The pixel where the cube's middle is seen."""
    from bpy_extras.object_utils import world_to_camera_view

    seen = world_to_camera_view(bpy.context.scene, bpy.context.scene.camera, box.location)
    height, width = picture.shape[:2]
    return picture[int((1 - seen.y) * height), int(seen.x * width)]


def test_a_cube_hides_a_person_behind_it_and_is_hidden_by_one_before_it(pair):
    stage, box = pair
    box.hide_render = True
    alone = render_png(stage.out)
    box.hide_render = False
    pixels = {}
    for y in (-0.8, 0.8):
        box.location.y = y
        picture = render_png(stage.out)
        pixels[y] = centre_of(box, picture)
        assert pixels[y][3] == 255
    red, hidden = pixels[-0.8], pixels[0.8]
    assert red[0] > 150 > 90 > red[1]
    assert np.abs(hidden - centre_of(box, alone)).max() <= 1


def test_a_cube_inside_a_person_shows_only_where_it_sticks_out(pair):
    stage, box = pair
    box.scale = (6.0, 0.1, 0.5)  # a bar through the chest, wider than the body
    picture = render_png(stage.out)
    red = (picture[..., 0] > 120) & (picture[..., 1] < 100) & (picture[..., 3] == 255)
    row = red[int(48 - 0.2 / 4 * 133)]
    assert row[:36].any()
    assert row[60:].any()
    middle = picture[int(48 - 0.2 / 4 * 133), 48]
    assert not (middle[0] > 150 and middle[1] < 60)


@pytest.mark.parametrize("way", ["object", "collection"])
def test_a_holdout_cuts_a_hole_into_person_and_background(pair, way):
    stage, box = pair
    box.location.y = -0.8
    stage.scene.render.film_transparent = False
    stage.scene.world = bpy.data.worlds.new("World")
    if way == "object":
        box.is_holdout = True
    else:
        masks = bpy.data.collections.new("masks")
        stage.scene.collection.children.link(masks)
        masks.objects.link(box)
        stage.scene.collection.objects.unlink(box)
        bpy.context.view_layer.layer_collection.children["masks"].holdout = True
    picture = render_png(stage.out)
    assert not centre_of(box, picture).any()
    assert picture[0, 0, 3] == 255


@pytest.mark.parametrize(
    "view", ["DEPTH", *(pytest.param(view, marks=pytest.mark.any_blender) for view in ("ALPHA", "BOXES"))]
)
def test_every_view_shows_the_person_in_its_own_way(pair, view):
    stage, box = pair
    box.hide_render = True
    colour = render_png(stage.out)
    stage.scene.primdiffusion_render.view = view
    picture = render_png(stage.out)
    assert picture[..., 3].any()
    assert np.abs(picture - colour).max() > 50
    if view == "ALPHA":
        assert np.abs(picture[..., 0] - colour[..., 3]).max() <= 1
