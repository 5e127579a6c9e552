"""What Cycles draws is where, and what, the cameras and the body say."""

import json
import struct
from pathlib import Path

import bpy
import numpy as np
import pytest
import trimesh
from blender_primdiffusion.files.picture_files import DEPTH_UNIT
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.camera_rig import Rig, View, look_at
from blender_primdiffusion.formats.capture_layout import COMPLETE_FILE, picture_path, view_seed
from blender_primdiffusion.formats.joints import JOINT_NAMES
from bpy_extras.object_utils import world_to_camera_view
from capture_person import NamedPerson, PaintedPerson, load_painted, plain, shader_of, two_poses
from mathutils import Vector
from PIL import Image
from scipy.ndimage import center_of_mass, grey_dilation
from support.capture_files import faults
from support.errors import refused

from blender_primdiffusion.capture.body import read_body
from blender_primdiffusion.capture.cameras import aim, view_of
from blender_primdiffusion.capture.job import run
from blender_primdiffusion.capture.passes import read_colours, read_exr, srgb_bytes, write_passes
from blender_primdiffusion.capture.settings import CaptureSettings
from blender_primdiffusion.capture.stage import CaptureScene, shoot_centres, shoot_colours
from blender_primdiffusion.capture.surfaces import mark_parts, prepare_materials
from blender_primdiffusion.files import picture_files
from blender_primdiffusion.scene.convention import points_to_blender

SIZE = 64
POSES = two_poses()


def odd_view() -> View:
    """A camera of another make: pixels that are no squares, the axis off the middle."""
    base = look_at(np.array([1.2, 0.7, 2.6]), np.array([0.1, -0.1, 0.0]), 0.6, 72, 48)
    return View(np.array([[90.0, 0, 41.3], [0, 75.0, 17.8], [0, 0, 1]]), base.rotation, base.translation, 72, 48)


@pytest.fixture
def stage(empty_scene, tmp_path):
    settings = CaptureSettings(tmp_path / "out", rig=Rig(count=3, width=SIZE, height=SIZE), samples=16, device="cpu")
    made = CaptureScene(empty_scene, settings)
    yield made
    made.close()


def put(stage: CaptureScene, frame: int = 1, **materials) -> PaintedPerson:
    with stage.entered() as own:
        person = PaintedPerson(own, read_body(), materials.get("paint") or plain((0.5, 0.25, 0.1)))
        person.pose(POSES.rotations[frame], POSES.translations[frame])
        for obj in person.objects:
            mark_parts(obj, person.joint_of_group)
        prepare_materials(person.objects, unlit=True)
    return person


def sphere(stage: CaptureScene, centre, radius: float, paint: bpy.types.Material) -> bpy.types.Object:
    with stage.entered() as own:
        ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
        mesh = bpy.data.meshes.new("ball")
        mesh.from_pydata(ball.vertices.tolist(), [], ball.faces.tolist())
        mesh.materials.append(paint)
        obj = bpy.data.objects.new("ball", mesh)
        obj.location = points_to_blender(np.asarray(centre))
        own.scene.collection.objects.link(obj)
    return obj


def cast(person: PaintedPerson, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] (inf: nothing) and face [H, W] behind the pixels' centres, by another program."""
    mesh = trimesh.Trimesh(person.vertices, person.faces, process=False)
    v, u = np.mgrid[: view.height, : view.width] + 0.5
    in_camera = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.intrinsics).T
    rays = (in_camera @ view.rotation).reshape(-1, 3)  # z of a ray is 1, so its length is depth
    at, ray, face = mesh.ray.intersects_location(np.tile(view.position, (len(rays), 1)), rays, multiple_hits=True)
    depth = (at @ view.rotation.T + view.translation)[:, 2]
    nearest, faces = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for order in np.argsort(-depth):
        nearest[ray[order]], faces[ray[order]] = depth[order], face[order]
    return nearest.reshape(view.height, view.width), faces.reshape(view.height, view.width)


@pytest.mark.parametrize("which", [pytest.param("rig", marks=pytest.mark.any_blender), "odd"])
def test_depth_is_what_rays_through_the_centres_of_pixels_meet(stage, which):
    person = put(stage)
    view = Rig(count=3, width=SIZE, height=SIZE).views(np.zeros(3), 1.1)[2] if which == "rig" else odd_view()
    centres = shoot_centres(stage, view, seed=5)
    depth, _ = cast(person, view)
    assert (np.isfinite(depth) != np.isfinite(centres.depth)).mean() < 0.001
    both = np.isfinite(depth) & np.isfinite(centres.depth)
    assert both.sum() > 300
    off = np.abs(depth[both] - centres.depth[both])
    assert np.quantile(off, 0.99) < 1e-3  # the rest are rays that graze an edge
    assert np.median(off) < 1e-4


def test_parts_and_normals_are_those_of_the_faces_that_are_met(stage):
    person, view = put(stage), odd_view()
    centres = shoot_centres(stage, view, seed=1)
    depth, faces = cast(person, view)
    weights = read_body().skin_weights[person._kept]
    part = 1 + weights[person.faces].sum(1).argmax(1)
    met = np.isfinite(depth) & np.isfinite(centres.depth)
    assert (centres.part[met] == part[faces[met]]).mean() > 0.995
    assert (centres.part[~np.isfinite(centres.depth)] == 0).all()
    assert set(np.unique(centres.part)) >= {1 + JOINT_NAMES.index(name) for name in ("left_hip", "right_knee", "head")}
    corners = person.vertices[person.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    agreement = (centres.normal[met] * normal[faces[met]]).sum(-1)
    assert np.quantile(agreement, 0.01) > 0.99
    assert np.allclose(np.linalg.norm(centres.normal[met], axis=-1), 1, atol=1e-3)


@pytest.mark.parametrize("which", [pytest.param("rig", marks=pytest.mark.any_blender), "odd"])
def test_a_marker_at_a_vertex_is_drawn_where_the_camera_puts_it(stage, which):
    view = Rig(count=3, width=SIZE, height=SIZE).views(np.zeros(3), 1.1)[1] if which == "rig" else odd_view()
    person = put(stage)
    depth, faces = cast(person, view)
    v, u = np.argwhere(np.isfinite(depth))[150]
    vertex = person.vertices[person.faces[faces[v, u], 0]]
    ball = sphere(stage, vertex, 0.03, plain((1, 1, 1)))
    with stage.entered():
        prepare_materials([ball], unlit=True)
        person.objects[0].hide_render = True
    colours = shoot_colours(stage, view, seed=0, samples=64)
    row, column = center_of_mass(colours.rgb.sum(-1))
    expected, _ = view.project(vertex)
    assert np.abs((column + 0.5, row + 0.5) - expected).max() < 0.1


@pytest.mark.any_blender
def test_joints_are_where_spheres_at_them_are_drawn(stage):
    view = Rig(count=1, width=256, height=256).views(np.zeros(3), 1.1)[0]
    person = put(stage)
    joints = person.pose(POSES.rotations[1], POSES.translations[1])
    person.objects[0].hide_render = True
    pixels, _ = view.project(joints)
    for joint in (0, 4, 15, 20, 23):
        ball = sphere(stage, joints[joint], 0.02, plain((1, 1, 1)))
        with stage.entered():
            prepare_materials([ball], unlit=True)
        row, column = center_of_mass(shoot_colours(stage, view, seed=0, samples=16).alpha)
        assert np.abs((column + 0.5, row + 0.5) - pixels[joint]).max() < 0.1
        ball.hide_render = True


def test_coverage_is_the_share_of_the_pixel(stage):
    paint = plain((0.5, 0.25, 0.1))
    view = look_at(np.array([0.0, 0.0, 4.0]), np.zeros(3), 0.6, SIZE, SIZE)
    ball = sphere(stage, (0, 0, 0), 0.6, paint)
    with stage.entered():
        prepare_materials([ball], unlit=True)
    colours = shoot_colours(stage, view, seed=3, samples=64)
    finer = 32
    v, u = (np.mgrid[: SIZE * finer, : SIZE * finer] + 0.5) / finer
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(view.intrinsics).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    hit = 4.0**2 * (1 - rays[..., 2] ** 2) < 0.6**2  # distance of the ray from the sphere's centre
    share = hit.reshape(SIZE, finer, SIZE, finer).mean((1, 3))
    assert np.abs(colours.alpha - share).max() < 0.06
    assert np.abs(colours.alpha - share).mean() < 0.002
    assert np.allclose(colours.rgb, colours.alpha[..., None] * (0.5, 0.25, 0.1), atol=1e-4)


def test_rays_go_through_holes_in_a_texture_and_every_pass_shows_what_is_behind(stage):
    with stage.entered() as own:
        image = bpy.data.images.new("half", 2, 1, alpha=True)
        image.pixels.foreach_set(np.array([0, 1, 0, 0, 0, 1, 0, 1], np.float32))
        image.pack()
        paint = plain((1, 1, 1))
        texture = paint.node_tree.nodes.new("ShaderNodeTexImage")
        texture.image, texture.interpolation = image, "Closest"
        for name, socket in (("Color", "Base Color"), ("Alpha", "Alpha")):
            paint.node_tree.links.new(texture.outputs[name], shader_of(paint).inputs[socket])
        mesh = bpy.data.meshes.new("card")
        mesh.from_pydata([(-1, -0.5, -1), (1, -0.5, -1), (1, -0.5, 1), (-1, -0.5, 1)], [], [(0, 1, 2, 3)])
        mesh.uv_layers.new().data.foreach_set("uv", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
        mesh.materials.append(paint)
        card = bpy.data.objects.new("card", mesh)
        card.vertex_groups.new(name="head").add([0, 1, 2, 3], 1.0, "REPLACE")
        own.scene.collection.objects.link(card)
        mark_parts(card, JOINT_NAMES.index)
    ball = sphere(stage, (0, 0, 0), 0.4, plain((0, 0, 1)))
    with stage.entered():
        ball.vertex_groups.new(name="spine1").add(range(len(ball.data.vertices)), 1.0, "REPLACE")
        mark_parts(ball, JOINT_NAMES.index)
        prepare_materials([ball, card], unlit=True)
    view = look_at(np.array([0.0, 0.0, 4.0]), np.zeros(3), 0.8, SIZE, SIZE)
    colours, centres = shoot_colours(stage, view, 0, 4), shoot_centres(stage, view, 0)
    middle, left, right = SIZE // 2, SIZE // 2 - 3, SIZE // 2 + 3
    assert np.allclose(colours.rgb[middle, left], (0, 0, 1), atol=1e-3)
    assert np.allclose(colours.rgb[middle, right], (0, 1, 0), atol=1e-3)
    assert abs(centres.depth[middle, left] - 3.6) < 0.03
    assert abs(centres.depth[middle, right] - 3.5) < 0.01
    assert (centres.part[middle, left], centres.part[middle, right]) == tuple(
        1 + JOINT_NAMES.index(name) for name in ("spine1", "head")
    )
    above = SIZE // 2 - 14  # over the ball: nothing is behind the hole
    assert colours.alpha[above, left] == 0
    assert np.isinf(centres.depth[above, left])
    assert centres.part[above, left] == 0


def test_a_users_camera_and_ours_see_the_same(empty_scene):
    scene = empty_scene.scene
    data = bpy.data.cameras.new("mine")
    camera = bpy.data.objects.new("mine", data)
    scene.collection.objects.link(camera)
    data.lens, data.shift_x, data.shift_y, data.sensor_fit = 41.0, 0.1, -0.07, "VERTICAL"
    camera.location, camera.rotation_euler, camera.scale = (1.0, -3.0, 0.5), (1.4, 0.1, 0.3), (2.0, 2.0, 2.0)
    bpy.context.view_layer.update()
    size = (80, 50)
    view = view_of(camera, empty_scene.evaluated_depsgraph_get(), size)
    other = bpy.data.objects.new("ours", bpy.data.cameras.new("ours"))
    scene.collection.objects.link(other)
    aspect = aim(other, view)
    bpy.context.view_layer.update()
    again = view_of(other, empty_scene.evaluated_depsgraph_get(), size, aspect)
    assert np.allclose(again.intrinsics, view.intrinsics, atol=1e-4)
    assert np.allclose(again.rotation, view.rotation, atol=1e-6)
    assert np.allclose(again.translation, view.translation, atol=1e-6)
    scene.render.resolution_x, scene.render.resolution_y = size
    point = np.array([0.3, 0.2, -0.4])
    x, y, _ = world_to_camera_view(scene, camera, Vector(points_to_blender(point)))
    assert np.allclose(view.project(point)[0], (x * 80, (1 - y) * 50), atol=1e-3)


@pytest.mark.any_blender
@pytest.mark.parametrize(
    ("own", "parents"),
    [((-1, -1, -1), (1, 1, 1)), ((-1, 1, 1), (1, 1, 1)), ((1, 1, 1), (1, 1, 3)), ((0, 1, 1), (1, 1, 1))],
)
def test_cameras_whose_picture_is_no_view_of_a_camera_are_refused(empty_scene, own, parents):
    """Mirrored by a negative scale, or sheared by a parent that is scaled unevenly."""
    camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    parent = bpy.data.objects.new("dolly", None)
    for obj in (camera, parent):
        empty_scene.scene.collection.objects.link(obj)
    camera.parent, camera.rotation_euler, camera.scale, parent.scale = parent, (0.4, 0.3, 0.2), own, parents
    bpy.context.view_layer.update()
    with refused(ValueError, "'mine'", "scale"):
        view_of(camera, empty_scene.evaluated_depsgraph_get(), (80, 50))


def test_files_hold_what_was_rendered(empty_scene, tmp_path):
    rig = Rig(count=2, elevations=(10.0,), width=SIZE, height=SIZE)
    settings = CaptureSettings(tmp_path, rig=rig, samples=4, background="transparent", device="cpu")
    list(run(empty_scene, settings, [NamedPerson("anna")], poses=POSES, load=load_painted))
    read = {
        kind: np.asarray(Image.open(picture_path(tmp_path / "anna", kind, 1, 1))).astype(int)
        for kind in ("img", "mask", "depth", "normal", "part", "rgba")
    }
    assert [read[kind].shape[2:] for kind in read] == [(3,), (), (), (3,), (), (4,)]
    assert (read["rgba"][..., 3] == read["mask"]).all()
    solid = read["mask"] == 255
    assert solid.sum() > 100
    difference = read["img"] @ (0.299, 0.587, 0.114) - read["rgba"][..., :3] @ (0.299, 0.587, 0.114)
    assert np.abs(difference)[solid].mean() < 5  # JPEG keeps brightness better than colour
    far = grey_dilation(read["mask"], 33) == 0  # from the person, farther than JPEG's blocks
    assert far.sum() > 200
    assert (read["img"][far] < 4).all()
    assert ((read["depth"] > 0) == (read["part"] > 0)).all()
    assert ((read["depth"] > 0) >= solid).mean() > 0.99
    cameras = json.loads((tmp_path / "anna/cameras.json").read_text())["camera0001"]
    distance = np.linalg.norm(cameras["T"])
    assert np.abs(read["depth"][solid] * DEPTH_UNIT - distance).max() < 1.2
    two = {(0.9, 0.3, 0.1), (0.1, 0.4, 0.8)}  # the chequers' colours are sRGB
    nearest = np.min([np.abs(read["rgba"][..., :3] / 255 - colour).max(-1) for colour in two], 0)
    assert (nearest[solid] < 0.02).mean() > 0.25  # the others mix two squares


def read_by_blender(path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    found = pixels.reshape(image.size[1], image.size[0], 4)[::-1, :, 0]
    bpy.data.images.remove(image)
    return found


@pytest.mark.any_blender
def test_float_depth_in_files_is_what_rays_meet(stage, tmp_path):
    person, view = put(stage), odd_view()
    write_passes(tmp_path, ("depth", "depth_float"), (0, 0), None, shoot_centres(stage, view, seed=5))
    metres = read_by_blender(picture_path(tmp_path, "depth_float", 0, 0))
    depth, _ = cast(person, view)
    assert (np.isfinite(depth) != (metres > 0)).mean() < 0.001
    both = np.isfinite(depth) & (metres > 0)
    assert both.sum() > 300
    assert np.median(np.abs(depth - metres)[both]) < 1e-5
    steps = np.asarray(Image.open(picture_path(tmp_path, "depth", 0, 0)))
    assert np.abs(metres - steps * DEPTH_UNIT).max() <= DEPTH_UNIT / 2 + 1e-6


@pytest.mark.any_blender
def test_float_depth_is_a_pass_that_is_asked_for(empty_scene, tmp_path):
    rig = Rig(count=1, width=SIZE, height=SIZE)
    assert "depth_float" not in CaptureSettings(tmp_path, rig=rig).about(1)["passes"]
    settings = CaptureSettings(tmp_path, rig=rig, passes=("img",), float_depth=True, samples=1, device="cpu")
    list(run(empty_scene, settings, [NamedPerson("anna")], poses=POSES, load=load_painted))
    assert not faults(tmp_path)
    path = picture_path(tmp_path / "anna", "depth_float", 0, 1)
    assert (read_by_blender(path) > 0).sum() > 300


def save_hdri(path, colour) -> None:
    """Radiance's format: a sky of one colour, below one, above the horizon, black below it."""
    sky = bytes([*(round(256 * value) for value in colour), 128])  # the last is the exponent, 0
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n" + 64 * sky + 64 * bytes(4))


def test_hdris_of_a_folder_light_views_by_their_seeds_and_are_behind_people(empty_scene, tmp_path):
    colours = {"a.hdr": (0.9, 0.1, 0.1), "b.hdr": (0.1, 0.9, 0.1), "c.hdr": (0.1, 0.1, 0.9)}
    (tmp_path / "skies").mkdir()
    for name, colour in colours.items():
        save_hdri(tmp_path / "skies" / name, colour)
    rig = Rig(count=3, elevations=(0.0,), width=SIZE, height=SIZE)
    settings = CaptureSettings(
        tmp_path / "out", rig=rig, samples=4, light="hdri", hdri=tmp_path / "skies", background="hdri", device="cpu",
        passes=("img", "mask"),
    )  # fmt: skip
    assert settings.about(2)["hdris"] == list(colours)
    before = set(bpy.data.images)
    list(run(empty_scene, settings, [NamedPerson("anna")], poses=POSES, load=load_painted))
    assert set(bpy.data.images) <= before | {image for image in bpy.data.images if image.type == "RENDER_RESULT"}
    used = set()
    for camera in range(3):
        behind, alone, mask = (
            np.asarray(Image.open(picture_path(tmp_path / "out/anna", kind, camera, 0))).astype(int)
            for kind in ("hdri", "img", "mask")
        )
        name = list(colours)[view_seed(0, "anna", 0, camera) % 3]
        used.add(name)
        above, below = behind[:4, :8].mean((0, 1)), behind[-4:, :8].mean((0, 1))
        assert np.abs(above - srgb_bytes(np.array(colours[name]))).max() < 4
        assert below.max() < 4
        assert alone[:4, :8].max() < 16
        brightness = (behind - alone) @ (0.299, 0.587, 0.114)
        assert np.abs(brightness)[mask == 255].mean() < 6  # JPEG keeps brightness better than colour
    assert len(used) > 1
    again = picture_path(tmp_path / "out/anna", "hdri", 2, 1)
    content = again.read_bytes()
    again.unlink()
    (tmp_path / "out/anna" / COMPLETE_FILE).unlink()
    list(run(empty_scene, settings, [NamedPerson("anna")], poses=POSES, load=load_painted))
    assert again.read_bytes() == content


@pytest.mark.any_blender
def test_a_background_of_hdris_needs_them(tmp_path):
    with refused(ValueError, "hdri"):
        CaptureSettings(tmp_path, background="hdri")
    with refused(ValueError, str(tmp_path)):
        CaptureSettings(tmp_path, light="hdri", hdri=tmp_path)
    assert "hdris" not in CaptureSettings(tmp_path, light="hdri", hdri=tmp_path / "a.hdr").about(1)


@pytest.mark.any_blender
def test_colours_are_encoded_as_srgb():
    assert srgb_bytes(np.array([0.0, 0.002, 0.2140411, 1.0, 3.0, -1.0])).tolist() == [0, 7, 127, 255, 255, 0]


def test_denoising_leaves_the_mask_alone(empty_scene, tmp_path):
    masks = {}
    for name in ("plain", "denoised"):
        settings = CaptureSettings(
            tmp_path / name, rig=Rig(count=1, width=SIZE, height=SIZE), samples=2, light="dome", passes=("img", "mask"),
            denoise=name == "denoised", device="cpu",
        )  # fmt: skip
        list(run(empty_scene, settings, [NamedPerson("anna")], poses=POSES.frames([0]), load=load_painted))
        masks[name] = picture_path(tmp_path / name / "anna", "mask", 0, 0).read_bytes()
    assert masks["plain"] == masks["denoised"]


WIDTH, HEIGHT = 6, 4


CHANNELS = tuple(f"ViewLayer.Combined.{name}" for name in "ABGR")


def exr(channels=CHANNELS, window=(0, 0, WIDTH - 1, HEIGHT - 1), lines=range(HEIGHT), fill=0.5) -> bytes:
    def entry(name: bytes, kind: bytes, data: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data

    listed = b"".join(name.encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for name in channels) + b"\0"
    head = struct.pack("<ii", 20000630, 2) + entry(b"channels", b"chlist", listed)
    head += entry(b"compression", b"compression", b"\0")
    head += entry(b"dataWindow", b"box2i", struct.pack("<4i", *window)) + b"\0"
    row = np.full(WIDTH * len(channels), fill, "<f4").tobytes()
    first = len(head) + 8 * HEIGHT
    offsets = [first + k * (8 + len(row)) for k in range(HEIGHT)]
    return head + struct.pack(f"<{HEIGHT}Q", *offsets) + b"".join(struct.pack("<ii", y, len(row)) + row for y in lines)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.any_blender
def test_nan_is_black(tmp_path):
    path = written(tmp_path / "a.exr", exr(fill=np.nan))
    assert np.isnan(read_exr(path)[CHANNELS[0]]).all()
    colours = read_colours(path)
    assert colours.rgb.shape == (HEIGHT, WIDTH, 3)
    assert not colours.rgb.any()
    assert not colours.alpha.any()


@pytest.mark.any_blender
@pytest.mark.parametrize(
    "content",
    [
        exr(window=(0, 0, 2**30, 3)),
        exr(window=(-(2**31), 0, 2**31 - 1, 3)),
        exr(window=(0, 0, 5, 2**30)),
        exr(lines=(1, 1, 1, 1)),
        exr(lines=(0, 2**31 - 1, 1, 2)),
        exr(channels=CHANNELS[:3]),
        exr()[:-1],
        b"",
    ],
    ids=["wide", "wider", "tall", "one line", "far line", "no red", "cut", "empty"],
)  # fmt: skip
def test_a_damaged_picture_is_one_sentence(tmp_path, content):
    path = written(tmp_path / "a.exr", content)
    with refused(FileError, "a.exr") as error:
        read_colours(path)
    assert len(str(error.value)) - len(str(tmp_path)) < 300


@pytest.mark.parametrize("shape", [(1, 1), (16, 5), (37, 53), (64, 48)])
def test_blender_reads_the_numbers_of_an_exr(tmp_path, shape):
    values = np.random.default_rng(0).uniform(0, 50, shape).astype(np.float32)
    values[: shape[0] // 2] = 0
    path = tmp_path / "a.exr"
    picture_files.write_exr(path, values)
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        assert image.is_float
        assert tuple(image.size) == (shape[1], shape[0])
        pixels = np.empty(4 * values.size, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    assert np.array_equal(pixels.reshape(*shape, 4)[::-1, :, 0], values)
    with refused(ValueError, str((*shape, 3))):
        picture_files.write_exr(path, np.zeros((*shape, 3)))
