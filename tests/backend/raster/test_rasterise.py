"""The plain rasteriser: by hand, and against Embree's rays."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh
from capture_scenes import GREEN, RED, WHITE, square
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.rasterise import rasterise
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


def knot() -> trimesh.Trimesh:
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
    shape = knot()
    mesh = TexturedMesh((part(shape.vertices, shape.faces),))
    size = 256
    if kind == "perspective":
        view = look_at(
            torch.tensor([1.0, 0.7, 4.0]).double(), torch.zeros(3).double(), vertical_fov=0.7, width=size, height=size
        )
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
