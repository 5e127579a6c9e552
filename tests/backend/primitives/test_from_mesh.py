import dataclasses
import math

import numpy as np
import torch
import trimesh
from primdiffusion.geometry.camera import look_at
from primdiffusion.geometry.image import Image
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.primitives.from_mesh import FULL_DENSITY, colour, from_mesh, nearest, surface_field, voxel_centres
from primdiffusion.primitives.primitives import Frames, Primitives
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.image import Rendering
from primdiffusion.render.march import march
from support.errors import refused

RADIUS = 0.3


def textured(shape: trimesh.Trimesh, texture, corner_uv=None, name="part") -> TexturedPart:
    faces = shape.faces.astype(np.int32)
    return TexturedPart(
        name=name,
        vertices=np.asarray(shape.vertices, np.float64),
        faces=faces,
        corner_uv=np.zeros((len(faces), 3, 2), np.float32) if corner_uv is None else corner_uv.astype(np.float32),
        texture=np.asarray(texture, np.uint8),
        skin_index=np.zeros((len(shape.vertices), 1), np.int32),
        skin_weight=np.ones((len(shape.vertices), 1)),
    )


def plain(red: int, green: int, blue: int) -> np.ndarray:
    return np.array([[[red, green, blue, 255]]], np.uint8)


def two_coloured_ball(upper=(220, 60, 40), lower=(40, 90, 200)) -> TexturedMesh:
    """A ball whose texture has two halves; v follows the height."""
    shape = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    corners = shape.vertices[shape.faces]
    uv = np.stack([np.full(corners.shape[:2], 0.5), 0.5 + 0.49 * corners[..., 1] / RADIUS], -1)
    texture = np.zeros((64, 64, 4), np.uint8)
    texture[:32], texture[32:] = (*upper, 255), (*lower, 255)
    return TexturedMesh((textured(shape, texture, uv),))


def frames_on(points: np.ndarray, normals: np.ndarray, half_extent) -> Frames:
    helper = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    rotation = np.stack([tangent, np.cross(normals, tangent), normals], -1)
    return Frames(
        torch.tensor(points, dtype=torch.float32),
        torch.tensor(rotation, dtype=torch.float32),
        torch.tensor(half_extent, dtype=torch.float32).expand(len(points), 3),
    )


def frames_on_ball(count: int = 800, radius: float = RADIUS) -> Frames:
    """Boxes evenly around a sphere (Fibonacci's spiral), overlapping their neighbours as those of a body do."""
    i = np.arange(count) + 0.5
    y, around = 1 - 2 * i / count, math.pi * (1 + 5**0.5) * i
    normals = np.stack([np.sqrt(1 - y * y) * np.cos(around), y, np.sqrt(1 - y * y) * np.sin(around)], -1)
    spacing = math.sqrt(4 * math.pi / count) * radius
    return frames_on(radius * normals, normals, [0.9 * spacing, 0.9 * spacing, 0.035])


def side_by_side(mesh: TexturedMesh, frames: Frames, yaw: float = 0.6, pitch: float = 0.3) -> tuple[Image, Rendering]:
    direction = torch.tensor([math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)])
    camera = look_at(2 * direction, torch.zeros(3), vertical_fov=0.5, width=200, height=200)
    marched = march(Primitives.place(frames, from_mesh(mesh, frames)), camera)
    cosine = camera.rays()[1] @ camera.world_to_camera[2, :3]
    return rasterise(mesh, camera, 2), dataclasses.replace(marched, depth=marched.depth * cosine)


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / (first | second).sum())


def test_a_ball_renders_back():
    mesh, frames = two_coloured_ball(), frames_on_ball()
    drawn, marched = side_by_side(mesh, frames)
    alpha = marched.alpha.numpy()
    assert overlap(drawn.alpha > 0.5, alpha > 0.5) > 0.97
    inside = (drawn.alpha == 1) & (alpha > 0.99)
    assert np.abs(drawn.rgb[inside] - marched.rgb.numpy()[inside]).mean() < 0.02
    depth_error = np.abs(marched.depth.numpy()[inside] - drawn.depth[inside])
    assert np.median(depth_error) < 0.02  # half opaque about one ramp below the surface


def test_colours_of_two_boxes_stay_their_own():
    """Two boxes of different parts, 12 cm apart; every voxel near one has that one's colour."""
    left, right = (trimesh.creation.box((0.2, 0.2, 0.2)).apply_translation([x, 0, 0]) for x in (-0.16, 0.16))
    mesh = TexturedMesh(
        (textured(left, plain(255, 0, 0), name="left"), textured(right, plain(0, 0, 255), name="right"))
    )
    frames = frames_on(
        np.array([[-0.16, 0, 0.1], [0.16, 0, 0.1]]), np.array([[0, 0, 1.0], [0, 0, 1.0]]), [0.05, 0.05, 0.03]
    )
    rgb = from_mesh(mesh, frames).rgb
    torch.testing.assert_close(rgb[0, 0], torch.ones(8, 8, 8))
    torch.testing.assert_close(rgb[1, 2], torch.ones(8, 8, 8))
    assert rgb[0, 1:].abs().max() == 0
    assert rgb[1, :2].abs().max() == 0


def test_density_is_zero_outside_and_full_deep_inside():
    mesh, frames = two_coloured_ball(), frames_on_ball(200)
    field = surface_field(mesh, frames)
    below = RADIUS - np.linalg.norm(voxel_centres(frames), axis=-1)
    assert (field.density[below < -0.004] == 0).all()
    assert (field.density[below > 0.04] == FULL_DENSITY).all()
    partly = field.density[(below > 0.008) & (below < 0.016)]
    assert ((partly > 0) & (partly < FULL_DENSITY)).mean() > 0.9


def test_voxels_lie_along_the_axes_of_their_box():
    """Index W walks along T, H along B, D along N; the first is at -1 and the last at +1."""
    rotation = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    frames = Frames(torch.tensor([[1.0, 2.0, 3.0]]), rotation[None], torch.tensor([[0.1, 0.2, 0.3]]))
    centres = voxel_centres(frames)[0]
    centre, t, b, n = np.array([1.0, 2.0, 3.0]), rotation[:, 0].numpy(), rotation[:, 1].numpy(), rotation[:, 2].numpy()
    np.testing.assert_allclose(centres[0, 0, 0], centre - 0.1 * t - 0.2 * b - 0.3 * n, atol=1e-6)
    np.testing.assert_allclose(centres[0, 0, 7], centre + 0.1 * t - 0.2 * b - 0.3 * n, atol=1e-6)
    np.testing.assert_allclose(centres[0, 7, 0], centre - 0.1 * t + 0.2 * b - 0.3 * n, atol=1e-6)
    np.testing.assert_allclose(centres[7, 0, 0], centre - 0.1 * t - 0.2 * b + 0.3 * n, atol=1e-6)


def test_a_variant_needs_only_new_colours():
    mesh, variant, frames = two_coloured_ball(), two_coloured_ball((10, 200, 30), (250, 250, 120)), frames_on_ball(200)
    field = surface_field(mesh, frames)
    assert_same(colour(field, variant), from_mesh(variant, frames))
    assert (colour(field, mesh).rgb - colour(field, variant).rgb).abs().max() > 0.3


def test_the_same_mesh_gives_the_same_bits():
    mesh, frames = two_coloured_ball(), frames_on_ball(200)
    assert_same(from_mesh(mesh, frames), from_mesh(mesh, frames))


def assert_same(first, second):
    for field in dataclasses.fields(first):
        assert torch.equal(getattr(first, field.name), getattr(second, field.name)), field.name


def test_holes_of_a_texture_are_not_surface():
    """A card that is wholly transparent changes nothing."""
    ball, frames = two_coloured_ball(), frames_on_ball(200)
    card = trimesh.creation.box(3 * [1.99 * RADIUS])  # its corners stick out of the ball, not of its bounding box
    ghost = textured(card, np.array([[[255, 255, 255, 0]]], np.uint8), name="ghost")
    assert_same(from_mesh(ball, frames), from_mesh(TexturedMesh((*ball.parts, ghost)), frames))


def test_what_is_seen_down_a_collar_does_not_show_through_cloth():
    """A red ball in an open blue bowl 15 mm above it: below the rim, the bowl's voxels are blue throughout."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS - 0.015)
    cloth = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    cloth.update_faces(cloth.triangles_center[:, 1] < 0.18)
    parts = textured(ball, plain(255, 0, 0), name="skin"), textured(cloth, plain(0, 0, 255), name="cloth")
    normal = np.array([[0, 0.5, math.sqrt(0.75)]])
    frames = frames_on(RADIUS * normal, normal, [0.012, 0.012, 0.012])
    payload = from_mesh(TexturedMesh(parts), frames)
    dense = payload.density[0] > 0
    assert dense.float().mean() > 0.3
    assert payload.rgb[0, 0][dense].max() < 0.05
    assert payload.rgb[0, 2][dense].min() > 0.95


def test_fine_patterns_become_their_mean():
    """A chequer of one-texel squares, far finer than a voxel, is grey (in linear light), not noise."""
    ball = two_coloured_ball()
    chequer = np.zeros((1024, 1024, 4), np.uint8)
    chequer[..., :3] = 255 * (np.indices((1024, 1024)).sum(0) % 2)[..., None]
    chequer[..., 3] = 255
    corners = ball.parts[0].vertices[ball.parts[0].faces]
    uv = corners[..., :2].astype(np.float32)
    mesh = TexturedMesh((dataclasses.replace(ball.parts[0], texture=chequer, corner_uv=uv),))
    frames = frames_on(np.array([[0, 0, RADIUS]]), np.array([[0, 0, 1.0]]), [0.04, 0.04, 0.02])
    torch.testing.assert_close(from_mesh(mesh, frames).rgb, torch.full((1, 3, 8, 8, 8), 0.5), atol=1e-3, rtol=0)


def test_nearest_agrees_with_a_search_through_all_points():
    generator = np.random.default_rng(3)
    points = generator.random((3000, 3)).astype(np.float32)
    queries = (1.4 * generator.random((2000, 3)) - 0.2).astype(np.float32)
    axes = generator.normal(size=(2000, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    found = nearest(points, queries, axes.astype(np.float32), 0.5, 0.06)
    offset = points[None].astype(np.float64) - queries[:, None]
    every = np.linalg.norm(offset, axis=-1)
    within = every.min(1) < 0.06
    assert 0.1 < within.mean() < 0.9
    np.testing.assert_array_equal(found.index >= 0, within)
    np.testing.assert_array_equal(found.index[within], every.argmin(1)[within])
    np.testing.assert_allclose(found.distance[within], every.min(1)[within], rtol=1e-5)
    assert np.isinf(found.distance[~within]).all()
    along = np.einsum("qni,qi->qn", offset, axes)
    cost = np.where(every < 0.06, every**2 - along**2 + (0.5 * along) ** 2, np.inf)
    np.testing.assert_array_equal(found.along[within], cost.argmin(1)[within])
    assert (found.along != found.index)[within].mean() > 0.05


def test_what_bulges_out_keeps_its_colour():
    """A small dark dome on a light plate, like an iris on an eye: below the dome, voxels are dark and not light."""
    plate = trimesh.creation.box((0.3, 0.3, 0.1)).apply_translation([0, 0, -0.05])
    dome = trimesh.creation.icosphere(subdivisions=4, radius=0.015)
    parts = textured(plate, plain(255, 255, 255), name="plate"), textured(dome, plain(0, 0, 0), name="dome")
    frames = frames_on(np.zeros((1, 3)), np.array([[0, 0, 1.0]]), [0.03, 0.03, 0.03])
    centres = voxel_centres(frames)
    below = (np.hypot(centres[..., 0], centres[..., 1]) < 0.007) & (np.abs(centres[..., 2] + 0.013) < 0.005)
    assert below.any()
    assert from_mesh(TexturedMesh(parts), frames).rgb[:, 0].numpy()[below].max() < 0.1


def test_unusable_input_is_rejected():
    ball, frames = two_coloured_ball(), frames_on_ball(8)
    part = ball.parts[0]
    broken = dataclasses.replace(part, vertices=np.full_like(part.vertices, np.nan))
    with refused(ValueError, "NaN"):
        from_mesh(TexturedMesh((broken,)), frames)
    with refused(ValueError, "0 parts"):
        from_mesh(TexturedMesh(()), frames)
    with refused(ValueError, "texture"):
        from_mesh(TexturedMesh((dataclasses.replace(part, texture=np.zeros((0, 0, 4), np.uint8)),)), frames)
    with refused(ValueError, "frames", "NaN"):
        from_mesh(ball, dataclasses.replace(frames, position=frames.position * float("nan")))
    with refused(ValueError, "(1, 8, 3)"):
        from_mesh(ball, frames.map(lambda tensor: tensor[None]))
