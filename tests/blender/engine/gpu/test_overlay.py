"""What 3D views show of humans beside Blender's objects. `test_composite` draws."""

import math
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import synthetic_shape
from engine_stage import cube
from human_files import lose_data
from mathutils import Matrix

from blender_primdiffusion import engine
from blender_primdiffusion.engine.boxes import Boxes
from blender_primdiffusion.engine.gpu import overlay as module
from blender_primdiffusion.engine.gpu import scene_reading
from blender_primdiffusion.engine.gpu.overlay import Overlay
from blender_primdiffusion.engine.gpu.refine import MarchRequest
from blender_primdiffusion.engine.view import clip_of
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_backend
from blender_primdiffusion.scene.human import body_of
from blender_primdiffusion.scene.volume_nodes import volumes_of, write_volumes

SIZE = (40, 30)
LOOK_ALONG_Y = np.linalg.inv(np.array(Matrix.Translation((0.5, -5, 1)) @ Matrix.Rotation(math.pi / 2, 4, "X")))
PERSPECTIVE = np.array([[1.5, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1.0002, -0.20002], [0, 0, -1, 0]])
PARALLEL = np.array([[0.5, 0, 0, 0], [0, 0.6, 0, 0], [0, 0, -0.002, 0], [0, 0, 0, 1]])


class Uploads:
    """In place of `GpuHumans`: a box at the pelvis for each human, without a GPU."""

    def __init__(self):
        self.files = set()

    def holds(self, pose):
        return pose.file in self.files

    def placed(self, pose):
        self.files.add(pose.file)
        return None, Boxes(points_to_backend(pose.pelvis)[None], np.eye(3)[None], np.full((1, 3), 0.1))

    def keep_only(self, drawn):
        list(drawn)


@pytest.fixture
def people(addon, tmp_path, monkeypatch):
    """Two humans whose volumes viewports hide, and the scene's overlay."""
    uploads = Uploads()
    monkeypatch.setattr(scene_reading, "gpu_humans", lambda: uploads)
    monkeypatch.setattr(scene_reading, "READING_S", 60.0)  # two humans take longer on a busy machine
    found = []
    for seed, (name, x) in enumerate((("Anna", 0.0), ("Bert", 1.0))):
        human = build_human(addon, synthetic_shape.write(tmp_path / name, 12, seed), name)
        human.location.x = x
        write_volumes(human)
        found.append(human)
    bpy.context.view_layer.update()
    return SimpleNamespace(anna=found[0], bert=found[1], overlay=Overlay())


def context(matrix=PERSPECTIVE, shading="SOLID", volumes=True) -> SimpleNamespace:
    """As in the draw handler of a region."""
    bpy.context.view_layer.update()
    region = SimpleNamespace(width=SIZE[0], height=SIZE[1], as_pointer=lambda: 1)
    space = SimpleNamespace(
        local_view=None, shading=SimpleNamespace(show_xray=False, type=shading), as_pointer=lambda: 2,
        show_object_viewport_mesh=True, show_object_viewport_volume=volumes, show_object_viewport_pointcloud=True,
    )  # fmt: skip
    around = SimpleNamespace(window_matrix=matrix, view_matrix=LOOK_ALONG_Y)
    return SimpleNamespace(
        mode="OBJECT", region=region, space_data=space, region_data=around, scene=bpy.context.scene,
        view_layer=bpy.context.view_layer, evaluated_depsgraph_get=bpy.context.evaluated_depsgraph_get,
    )  # fmt: skip


def read(overlay, **view):
    overlay.scene_changed()
    return overlay.reading(context(**view))


def name_of(human) -> str:
    return {0: "Anna", 1: "Bert", 3: "Instance"}[round(human.pose.pelvis[0])]


def names(reading) -> list[str]:
    return sorted(map(name_of, reading.humans.values()))


def test_humans_whose_volumes_a_view_lights_are_left_to_its_engine(people):
    bpy.context.scene.render.engine = "CYCLES"
    assert names(read(people.overlay, shading="RENDERED")) == ["Anna", "Bert"]
    volumes_of(people.bert).hide_viewport = False
    assert names(read(people.overlay, shading="RENDERED")) == ["Anna"]
    assert names(read(people.overlay, shading="MATERIAL")) == ["Anna"]
    assert names(read(people.overlay, shading="RENDERED", volumes=False)) == ["Anna", "Bert"]
    assert names(read(people.overlay, shading="SOLID")) == ["Anna", "Bert"], "over the fog"
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    assert names(read(people.overlay, shading="RENDERED")) == ["Anna", "Bert"]


@pytest.mark.any_blender
def test_views_of_several_shadings_do_not_share_what_they_show(people):
    bpy.context.scene.render.engine = "CYCLES"
    volumes_of(people.bert).hide_viewport = False
    solid = read(people.overlay)
    rendered = people.overlay.reading(context(shading="RENDERED"))
    assert (names(solid), names(rendered)) == (["Anna", "Bert"], ["Anna"])
    assert people.overlay.reading(context()) is solid


@pytest.mark.any_blender
def test_humans_whose_meshes_viewports_show_are_not_drawn_twice(people):
    assert names(read(people.overlay)) == ["Anna", "Bert"]
    body_of(people.anna).hide_viewport = False
    assert names(read(people.overlay)) == ["Bert"]


def test_hidden_humans_are_not_drawn(people):
    people.anna.hide_viewport = True
    assert names(read(people.overlay)) == ["Bert"]


def test_an_instance_is_drawn_where_it_stands(people):
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", bpy.data.collections["Anna"]
    empty.location = (3, 0, 0)
    bpy.context.scene.collection.objects.link(empty)
    reading = read(people.overlay)
    assert names(reading) == ["Anna", "Bert", "Instance"]
    pelvis = {name_of(human): human.pose.pelvis for human in reading.humans.values()}
    np.testing.assert_allclose(pelvis["Instance"] - pelvis["Anna"], [3, 0, 0], atol=1e-5)


@pytest.mark.any_blender
def test_a_human_without_data_is_named_and_the_others_are_drawn(people):
    lose_data(people.anna)
    assert names(read(people.overlay)) == ["Bert"]
    assert "Anna" in people.overlay.error
    volumes_of(people.anna).hide_viewport = False
    assert names(read(people.overlay)) == ["Bert"]
    assert people.overlay.error == "", "the fog shows her"


@pytest.mark.any_blender
def test_files_of_new_humans_are_read_one_after_the_other(people, monkeypatch):
    monkeypatch.setattr(scene_reading, "READING_S", -1.0)
    first = read(people.overlay)
    assert len(first.humans) == 1
    assert not first.complete
    assert not people.overlay.resting
    assert people.overlay.advance()
    assert len(people.overlay.reading(context()).humans) == 2
    assert people.overlay.reading(context()).complete, "the last one needs no reading of its own"
    assert people.overlay.resting


@pytest.mark.any_blender
def test_marching_and_drawing_are_steps_of_their_own(monkeypatch):
    own, news = Overlay(), [False, True, True]
    pictures = SimpleNamespace(resting=False, fresh=False, advance=lambda: news.pop(0))
    own._regions[0] = pictures
    monkeypatch.setattr(module, "overlay", own)
    seen = []
    for _ in range(5):
        seconds = module._tick()
        pictures.resting = not news
        seen.append((seconds, own.undrawn))
    march, at_once = module.TICK_S, 0.0
    assert seen == [(march, False), (at_once, True), (march, False), (at_once, True), (None, False)]
    assert own.resting


@pytest.mark.any_blender
def test_what_a_scene_shows_is_read_again_only_when_it_has_changed(people):
    reading = read(people.overlay)
    assert people.overlay.reading(context()) is reading
    other = cube()
    people.overlay.scene_changed([other, other.data])
    assert people.overlay.reading(context()) is reading
    people.overlay.scene_changed([other, people.bert])
    assert people.overlay.reading(context()) is not reading
    people.anna.location.x = 0.5
    moved = read(people.overlay)
    assert len(set(moved.humans) & set(reading.humans)) == 1


def test_bones_in_front_stay_visible_unless_hidden(people):
    armature = people.anna
    armature.matrix_world = Matrix.Translation((2, 3, 4)) @ Matrix.Scale(2, 4)
    armature.show_in_front = True
    bone = armature.pose.bones["head"]
    head = armature.matrix_world @ bone.head
    bones = read(people.overlay).bones
    assert bones.shape == (24, 2, 3)
    assert np.abs(bones[:, 0] - head).sum(1).min() < 1e-5
    bone.hide = True
    bones = read(people.overlay).bones
    assert bones.shape == (23, 2, 3)


@pytest.mark.parametrize("mode", ["POSE", "EDIT"])
def test_bones_are_in_front_while_they_are_posed_or_edited(people, mode):
    armature = people.anna
    assert read(people.overlay).bones.shape == (0, 2, 3)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode=mode)
    assert read(people.overlay).bones.shape == (24, 2, 3)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert read(people.overlay).bones.shape == (0, 2, 3)
    assert not armature.show_in_front, "the user's own setting stays"


@pytest.mark.any_blender
def test_clip_planes_follow_from_the_projection():
    assert clip_of(PERSPECTIVE) == pytest.approx((0.1, 1000), rel=0.01)
    assert clip_of(PARALLEL) == pytest.approx((-500, 500))


def test_erasing_what_is_behind_humans_leaves_the_bones_of_the_same_reading(people, monkeypatch):
    drawn = []
    monkeypatch.setattr(module, "overlay", people.overlay)
    monkeypatch.setattr(module, "keep_bones_in_front", lambda _context, bones: drawn.append(bones))
    monkeypatch.setattr(module, "draw_picture", lambda picture, look: drawn.append((picture, look.erases)))
    module.erase_behind(context(shading="RENDERED"), "humans")
    assert drawn[0] is people.overlay.reading(context(shading="RENDERED")).bones
    assert drawn[1] == ("humans", True)


def region_after(region: int, show_overlays: bool = True) -> SimpleNamespace:
    """The context of a handler after the overlays of an engine's view."""
    space = SimpleNamespace(overlay=SimpleNamespace(show_overlays=show_overlays))
    return SimpleNamespace(region=SimpleNamespace(as_pointer=lambda: region), space_data=space)


@pytest.mark.any_blender
def test_overlays_are_erased_once_for_each_drawing_of_the_regions_view(monkeypatch):
    drawn, erased = {7: "humans", 8: "others"}, []
    monkeypatch.setattr(engine.viewport, "below_overlays", drawn)
    monkeypatch.setattr(engine, "shows_humans", lambda _context: False)
    monkeypatch.setattr(module, "erase_behind", lambda _context, humans: erased.append(humans))
    for around in (region_after(7), region_after(7), region_after(8, show_overlays=False), region_after(9)):
        monkeypatch.setattr(engine, "bpy", SimpleNamespace(context=around))
        engine._draw_humans()
    assert erased == ["humans"]
    assert not drawn


def drawing(monkeypatch, march) -> list[tuple]:
    """Let an overlay march by this function; the parts and pictures that it draws."""
    drawn = []
    monkeypatch.setattr(module, "gpu_marcher", lambda: SimpleNamespace(march=march))
    monkeypatch.setattr(module, "keep_bones_in_front", lambda *_given: None)
    monkeypatch.setattr(module, "_look", lambda *_given: None)
    monkeypatch.setattr(module, "draw_picture", lambda picture, _look, part: drawn.append((picture, part)))
    monkeypatch.setattr(module, "follow", lambda: None)
    return drawn


class Marched:
    """A picture that is complete at once."""

    def __init__(self, _humans, view, step):
        self.view, self.step = view, step

    def advance(self, _work):
        return True

    def wait(self):
        pass


@pytest.mark.any_blender
def test_a_gpu_that_cannot_march_is_not_asked_again_and_the_view_says_why(people, monkeypatch):
    asked = []

    def march(*given):
        asked.append(given)
        raise RuntimeError("the GPU is out of order")

    assert drawing(monkeypatch, march) == []
    for _ in range(4):
        people.overlay.draw(context())
    assert len(asked) == 1
    assert people.overlay.error.startswith("the GPU is out of order: show the volumes instead")
    assert people.overlay.resting


@pytest.mark.any_blender
def test_a_gpu_that_fails_while_a_view_rests_is_noticed(people, monkeypatch):
    drawn = drawing(monkeypatch, Marched)
    people.overlay.draw(context())
    people.overlay._regions[1]._changed_at = 0.0

    def fail(_self, _work):
        raise RuntimeError("the GPU is out of order")

    monkeypatch.setattr(Marched, "advance", fail)
    assert people.overlay.advance()
    people.overlay.draw(context())
    assert len(drawn) == 1
    assert people.overlay.error.startswith("the GPU is out of order")
    assert people.overlay.resting


@pytest.mark.any_blender
def test_each_redraw_of_a_moving_view_shows_all_of_the_new_one(people, monkeypatch):
    drawn = drawing(monkeypatch, Marched)
    for turn in range(5):
        view = context()
        view.region_data.view_matrix = LOOK_ALONG_Y @ np.array(Matrix.Rotation(0.1 * turn, 4, "Z"))
        people.overlay.draw(view)
        assert len(drawn) == turn + 1
    turns = {picture.view.world_to_camera.tobytes() for picture, _ in drawn}
    assert len(turns) == 5
    step, (first, _) = bpy.context.scene.primdiffusion_render.step, drawn[0]
    assert (first.view.width, first.step) == (SIZE[0] // 8, 8 * step)


@pytest.mark.any_blender
def test_a_view_that_the_engine_draws_now_is_not_refined_beside_it(monkeypatch):
    shown, overlay = context(), Overlay()
    overlay._picture_of(shown.region).want(MarchRequest("before", None, None))
    assert not overlay.resting
    monkeypatch.setattr(module, "overlay", overlay)
    monkeypatch.setattr(engine, "shows_humans", lambda _context: False)
    monkeypatch.setattr(engine, "bpy", SimpleNamespace(context=shown))
    engine._draw_humans()
    assert overlay.resting
