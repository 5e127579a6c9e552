"""The rasteriser, of pictures and of captures: by hand, and against Embree's rays."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh
from capture_scenes import BLUE, GREEN, RED, WHITE, box, square
from primdiffusion.capture.reader import as_camera
from primdiffusion.formats.camera_rig import View, look_at
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.rasterise import figure_from_mesh, rasterise
from primdiffusion.raster.shade import OrthographicView, view_along
from support.errors import refused


def part(vertices, faces, texture=(WHITE,), corner_uv=None) -> TexturedPart:
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    texture = np.asarray(texture, np.uint8)
    return TexturedPart(
        name="part",
        vertices=vertices,
        faces=faces,
        corner_uv=np.zeros((len(faces), 3, 2), np.float32) if corner_uv is None else np.asarray(corner_uv, np.float32),
        texture=texture[None] if texture.ndim == 2 else texture,
        skin_index=np.zeros((len(vertices), 1), np.int32),
        skin_weight=np.ones((len(vertices), 1)),
    )


FRONT = OrthographicView(  # looks along -z, 8 x 8 pixels over [-1/2, 1/2]^2, from z = 2
    np.array([[1.0, 0, 0, 0.5], [0, -1.0, 0, 0.5], [0, 0, -1.0, 2]]), pixel_size=1 / 8, width=8, height=8
)


def knotted() -> trimesh.Trimesh:
    """A closed surface that hides parts of itself."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    r = 1 + 0.35 * np.sin(5 * sphere.vertices[:, :1]) * np.cos(4 * sphere.vertices[:, 1:2])
    return trimesh.Trimesh(sphere.vertices * r, sphere.faces, process=False)


def test_a_triangle_covers_the_pixels_whose_centres_it_holds():
    view = OrthographicView(np.eye(4)[:3], 1.0, 4, 4)
    picture = rasterise(TexturedMesh((part([[0, 0, 1], [4, 0, 1], [0, 4, 1]], [[0, 1, 2]]),)), view)
    # Centres with x + y <= 4, the diagonal included.
    expected = [[1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 0]]
    np.testing.assert_array_equal(picture.alpha, expected)
    assert (picture.depth[picture.alpha > 0] == 1).all()
    assert np.isinf(picture.depth[picture.alpha == 0]).all()


def test_the_nearer_part_wins_whatever_the_order():
    near, far = square([[RED]], 0.5, 0.5), square([[GREEN]], -0.5)
    for parts in ((near, far), (far, near)):
        picture = rasterise(TexturedMesh(parts), FRONT)
        np.testing.assert_array_equal(picture.rgb[4, 4], [1, 0, 0])
        np.testing.assert_array_equal(picture.rgb[0, 0], [0, 1, 0])
        np.testing.assert_allclose(picture.depth[[4, 0], [4, 0]], [1.5, 2.5])


def test_supersampling_counts_covered_samples():
    view = OrthographicView(np.array([[1.0, 0, 0, 0.5], [0, -1.0, 0, 0.5], [0, 0, -1.0, 2]]), 1.0, 1, 1)
    half = TexturedMesh((square([[RED]], side=0.5),))
    picture = rasterise(half, view, supersample=8)
    assert picture.alpha[0, 0] == pytest.approx(0.25)
    np.testing.assert_allclose(picture.rgb[0, 0], [0.25, 0, 0])
    assert picture.depth[0, 0] == 2
    assert rasterise(half, view).alpha[0, 0] == 1


def test_perspective_textures_do_not_swim():
    """On a tilted square seen in perspective, the texture's middle line falls where the camera projects it."""
    tilt = part(
        [[-1, -1, 2], [1, -1, 2], [1, 1, 6], [-1, 1, 6]], [[0, 1, 2], [0, 2, 3]],
        np.array([[RED], [GREEN]]).repeat(64, 0), [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]],
    )  # fmt: skip
    camera = Camera(torch.tensor([[200.0, 0, 100], [0, 200, 100], [0, 0, 1]]), torch.eye(3, 4), 200, 200)
    picture = rasterise(TexturedMesh((tilt,)), camera, 4)
    column = picture.rgb[:, 100]
    # y down in the camera: v = 0 (green) is at y = -1, z = 2, row 0; the middle, y = 0, projects to row 100.
    assert column[90, 1] > 0.9
    assert column[120, 0] > 0.9
    switch = 60 + np.argmin(np.abs(column[60:125, 0] - column[60:125, 1]))
    assert abs(switch - 100) <= 1


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_silhouette_and_depth_agree_with_embree(kind):
    shape = knotted()
    mesh = TexturedMesh((part(shape.vertices, shape.faces),))
    size = 256
    if kind == "perspective":
        view = as_camera(look_at(np.array([1.0, 0.7, 4.0]), np.zeros(3), 0.7, size, size)).to(dtype=torch.float64)
        origin, directions = view.rays()
        directions = directions.reshape(-1, 3).numpy()
        origins, axis = np.broadcast_to(origin.numpy(), directions.shape), view.world_to_camera[2, :3].numpy()
    else:
        view = view_along((-0.5, -0.3, -1), shape.bounds, 3.2 / size)
        rotation, translation = view.world_to_view[:, :3], view.world_to_view[:, 3]
        v, u = np.mgrid[0 : view.height, 0 : view.width] + 0.5
        plane = np.stack([u * view.pixel_size, v * view.pixel_size, np.zeros_like(u)], -1).reshape(-1, 3)
        origins = (plane - translation) @ rotation
        directions, axis = np.broadcast_to(view.direction, origins.shape), view.direction
    picture = rasterise(mesh, view)
    caster = trimesh.ray.ray_pyembree.RayMeshIntersector(shape)
    places, rays, _ = caster.intersects_location(origins, directions, multiple_hits=False)
    depth = np.full(len(origins), np.inf)
    depth[rays] = (places - origins[rays]) @ axis
    depth = depth.reshape(picture.depth.shape)
    ours, theirs = picture.alpha > 0.5, np.isfinite(depth)
    assert theirs.mean() > 0.2
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.995
    error = np.abs(picture.depth[ours & theirs] - depth[ours & theirs])
    assert np.median(error) < 1e-5
    assert np.mean(error > 1e-3) < 0.002  # rays that pass an edge on the other side


def test_a_view_along_a_direction_holds_the_whole_box():
    bounds = np.array([[-0.2, 0.1, -0.5], [0.4, 1.9, 0.3]])
    for direction in ((0, 0, -1), (0, -1, 0), (1, -0.3, 0.7)):
        view = view_along(direction, bounds, 0.01)
        corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(8, 3)
        seen = corners @ view.world_to_view[:, :3].T + view.world_to_view[:, 3]
        assert (seen >= 0).all()
        assert (seen[:, 0] <= view.width * 0.01).all()
        assert (seen[:, 1] <= view.height * 0.01).all()
        assert math.isclose(np.linalg.det(view.world_to_view[:, :3]), 1)


def test_unusable_meshes_are_rejected():
    good = part([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    broken = dataclasses.replace(good, vertices=np.full((3, 3), np.nan))
    with refused(ValueError, "0 parts"):
        rasterise(TexturedMesh(()), FRONT)
    with refused(ValueError, "vertices"):
        rasterise(TexturedMesh((broken,)), FRONT)
    with refused(ValueError, "0 to 7"):
        rasterise(TexturedMesh((dataclasses.replace(good, faces=np.array([[0, 1, 7]], np.int32)),)), FRONT)
    with refused(ValueError, "texture"):
        rasterise(TexturedMesh((dataclasses.replace(good, texture=np.zeros((0, 4, 4), np.uint8)),)), FRONT)
    with refused(ValueError, "supersample is 0"):
        rasterise(TexturedMesh((good,)), FRONT, 0)


REST = np.tile(np.eye(4), (24, 1, 1))
HOLE = (9, 9, 9, 0)


def shot_of(*parts: TexturedPart, view: View, samples: int = 3):
    return figure_from_mesh(TexturedMesh(parts)).posed(REST)(view, samples)


def front(distance: float, focal: float, size: int) -> View:
    """A camera on +z that looks at the origin."""
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return View(intrinsics, np.diag([1.0, -1, -1]), np.array([0.0, 0, distance]), size, size)


def test_a_cubes_front_covers_what_the_pinhole_says():
    # A front face of 1 m, 2 m away, focal length 40 px: 20 pixels, from 10 to 30.
    shot = shot_of(box(), view=front(2.5, 40, 40))
    expected = np.zeros((40, 40))
    expected[10:30, 10:30] = 1
    np.testing.assert_array_equal(shot.alpha, expected)
    inside = shot.alpha > 0
    np.testing.assert_allclose(shot.depth[inside], 2, atol=1e-6)
    np.testing.assert_allclose(shot.rgb[inside], [[1, 0, 0]] * 400, atol=1e-6)
    assert (shot.part[inside] == 1).all()
    assert np.isinf(shot.depth[~inside]).all()
    assert not shot.part[~inside].any()
    assert (shot.normal[inside][:, 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(shot.normal[inside], axis=-1), 1, atol=1e-6)


def test_coverage_is_the_share_of_samples_and_colour_is_linear_and_premultiplied():
    # The square ends at pixel 10 + 1/3 on each side: one of three columns of samples.
    shot = shot_of(square([[(188, 188, 188, 255)]], side=1 + 1 / 30), view=front(2, 40, 40))
    assert shot.alpha[20, 9] == pytest.approx(1 / 3)
    assert shot.alpha[9, 9] == pytest.approx(1 / 9)
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(shot.rgb[20, [9, 20], 0], [linear / 3, linear], rtol=1e-5)


def test_textures_are_upright_and_holes_show_what_is_behind():
    texture = np.array([[RED, GREEN], [BLUE, HOLE]]).repeat(8, 0).repeat(8, 1)
    shot = shot_of(square(texture, 0), square([[WHITE]], -1, 9), view=front(2, 40, 40))
    corners = shot.rgb[[14, 14, 25, 25], [14, 25, 14, 25]]
    np.testing.assert_allclose(corners, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], atol=1e-6)
    assert shot.depth[25, 25] == pytest.approx(3)
    assert shot.depth[25, 14] == pytest.approx(2)
    assert shot.alpha.min() == 1


def test_the_edge_of_a_hole_lies_where_interpolated_alpha_is_one_half():
    texture = np.full((1, 2, 4), 255, np.uint8)
    texture[0, 0, 3], texture[0, 1, 3] = 51, 255  # from 0.2 to 1 between u = 1/4 and 3/4: one half at 0.4375
    shot = shot_of(square(texture), view=front(1, 400, 400), samples=1)
    assert np.flatnonzero(shot.alpha[200, 100:300])[0] + 100 == pytest.approx(400 * 0.4375, abs=1)


def test_holes_tint_nothing():
    texture = np.array([[RED, HOLE]]).repeat(4, 0).repeat(4, 1)
    shot = shot_of(square(texture), view=front(1, 30, 30))
    seen = shot.alpha > 0
    np.testing.assert_allclose(shot.rgb[seen] / shot.alpha[seen][:, None], [[1, 0, 0]] * int(seen.sum()), atol=1e-6)


def knot() -> TexturedPart:
    """The same in blocks of random colours."""
    shape = knotted()
    colours = np.random.default_rng(0).integers(0, 256, (8, 8, 4), np.uint8)
    colours[..., 3] = 255
    return dataclasses.replace(
        part(shape.vertices, shape.faces, corner_uv=shape.vertices[shape.faces][..., :2] / 4 + 0.5),
        texture=colours.repeat(16, 0).repeat(16, 1),
    )


def bilinear(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Linear colours of an opaque texture at [n, 2], interpolated as stored; v up, both wrap around."""
    rows, columns = texture.shape[:2]
    place = np.stack([(1 - uv[:, 1]) * rows, uv[:, 0] * columns], -1) - 0.5
    first = np.floor(place).astype(int)
    total = np.zeros((len(uv), 3))
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - np.array(corner) - (place - first)).prod(-1)
        row, column = ((first + corner) % (rows, columns)).T
        total += weight[:, None] * texture[row, column, :3]
    return decode_srgb(total / 255)


def test_silhouette_depth_and_colour_agree_with_embrees_rays_and_a_texture_read_by_hand():
    part, view = knot(), look_at(np.array([1.0, 0.7, 4.0]), np.zeros(3), 0.7, 160, 160)
    shot = shot_of(part, view=view, samples=1)
    origin, directions = (values.double().numpy() for values in as_camera(view).rays())
    directions = directions.reshape(-1, 3)
    caster = trimesh.ray.ray_pyembree.RayMeshIntersector(trimesh.Trimesh(part.vertices, part.faces, process=False))
    places, rays, faces = caster.intersects_location(
        np.broadcast_to(origin, directions.shape), directions, multiple_hits=False
    )
    seen = shot.alpha.ravel() > 0
    hit = np.zeros(len(directions), bool)
    hit[rays] = True
    assert hit.mean() > 0.2
    assert (hit == seen).mean() > 0.999
    both = seen[rays]
    rays, places, faces = rays[both], places[both], faces[both]
    error = np.abs(shot.depth.ravel()[rays] - (places - origin) @ view.rotation[2])
    assert np.median(error) < 1e-5
    assert np.mean(error > 1e-3) < 0.002  # rays that pass an edge on the other side
    weights = trimesh.triangles.points_to_barycentric(part.vertices[part.faces[faces]], places)
    expected = bilinear(part.texture, np.einsum("ni,nij->nj", weights, part.corner_uv[faces]))
    assert np.quantile(np.abs(shot.rgb.reshape(-1, 3)[rays] - expected).max(-1), 0.995) < 1e-3


@pytest.mark.parametrize("samples", [1, 3])
def test_captures_and_pictures_of_meshes_have_the_same_pixels(samples):
    part, view = knot(), look_at(np.array([1.0, 0.7, 4.0]), np.zeros(3), 0.7, 160, 160)
    shot, picture = (
        shot_of(part, view=view, samples=samples),
        rasterise(TexturedMesh((part,)), as_camera(view), samples),
    )
    assert np.mean(np.abs(shot.alpha - picture.alpha) > 1e-6) < 1e-3
    both = (shot.alpha == 1) & (picture.alpha == 1)
    assert both.mean() > 0.2
    assert np.abs(shot.rgb - picture.rgb)[both].mean() < 1e-4


def test_fine_textures_are_averaged_not_sampled():
    checks = np.indices((512, 512)).sum(0) % 2
    texture = np.where(checks[..., None], np.array(WHITE), np.array((0, 0, 0, 255))).astype(np.uint8)
    rgb = shot_of(square(texture), view=front(2, 50, 40)).rgb[10:30, 10:30]
    np.testing.assert_allclose(rgb, 0.5, atol=0.02)


def test_normals_are_smooth_across_seams_and_face_the_camera():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    torn = sphere.vertices[sphere.faces].reshape(-1, 3)  # every face with vertices of its own
    part = dataclasses.replace(
        box(), vertices=torn, faces=np.arange(len(torn), dtype=np.int32).reshape(-1, 3)[:, ::-1].copy(),
        corner_uv=np.zeros((len(torn) // 3, 3, 2), np.float32),
        skin_index=np.zeros((len(torn), 1), np.int32), skin_weight=np.ones((len(torn), 1)),
    )  # fmt: skip
    view = front(3, 60, 60)
    shot = shot_of(part, view=view, samples=1)
    seen = np.isfinite(shot.depth)
    place = np.stack([(np.indices((60, 60))[1] + 0.5 - 30) / 60, -(np.indices((60, 60))[0] + 0.5 - 30) / 60], -1)
    at = np.concatenate([place * shot.depth[..., None], 3 - shot.depth[..., None]], -1)
    cosine = (at * shot.normal).sum(-1)[seen] / np.linalg.norm(at, axis=-1)[seen]
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 0.5  # flat faces are 3 degrees off
    assert cosine.min() > 0.99


def test_even_samples_are_rejected():
    with refused(ValueError, "odd"):
        shot_of(box(), view=front(3, 40, 40), samples=2)


def test_skinning_moves_vertices_with_their_joints():
    moved = torch.eye(4).repeat(24, 1, 1).numpy().astype(np.float64)
    moved[3, :3, 3] = 1, 2, 3
    points = figure_from_mesh(TexturedMesh((box(joint=3), box("still")))).points(moved)
    np.testing.assert_allclose(points[:8].mean(0), [1, 2, 3])
    np.testing.assert_allclose(points[8:].mean(0), 0, atol=1e-12)
