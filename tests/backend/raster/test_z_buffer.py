"""Which triangle a pixel sees: against Embree's rays, and where triangles cross the camera's planes."""

import numpy as np
import pytest
import torch
import trimesh
from march_scenes import camera_at
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.render.solids import HEADLIGHT, SKY, Solids, shade_solids
from support.errors import refused

pytest.importorskip("embreex", reason="there is nothing to compare with")


def traced(mesh: trimesh.Trimesh, camera: Camera, start: float = 0.0) -> np.ndarray:
    """Depth along the optical axis of the nearest hit beyond `start`, by Embree; inf where there is none."""
    origin, rays = (value.double().numpy() for value in camera.rays())
    directions = rays.reshape(-1, 3)
    place, ray, _ = mesh.ray.intersects_location(np.tile(origin, (len(directions), 1)), directions, multiple_hits=True)
    view = camera.world_to_camera.double().numpy()
    hit = place @ view[2, :3] + view[2, 3]
    depth = np.full(len(directions), np.inf)
    np.minimum.at(depth, ray, np.where(hit >= start, hit, np.inf))
    return depth.reshape(camera.height, camera.width)


def still_life() -> trimesh.Trimesh:
    """A ball, a smaller one, a leaning box, and a floor that reaches far behind the camera."""
    small = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    small.apply_translation([0.9, 0.2, 0.8])
    box = trimesh.creation.box((0.5, 1.5, 0.2))
    box.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1, 2, 1], [0, 0, 0]))
    box.apply_translation([-1.1, 0, 0.5])
    floor = trimesh.creation.box((400, 0.1, 400))
    floor.apply_translation([0, -1, 0])
    return trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=4, radius=0.8), small, box, floor])


@pytest.mark.parametrize("position", [(1.0, 0.5, 4.0), (0.2, -0.9, 2.0), (-1.0, 3.0, -2.0), (0.1, 0.1, 0.1)])
def test_depth_is_that_of_traced_rays(position):
    mesh = still_life()
    camera = camera_at(position, fov=0.9, width=120, height=90)
    want = traced(mesh, camera)
    got = nearest_triangles(mesh.triangles, camera).depth
    assert (np.isfinite(want) == np.isfinite(got)).mean() > 0.9995
    both = np.isfinite(want) & np.isfinite(got)
    assert both.mean() > 0.2
    error = np.abs(got[both] - want[both]) / want[both]
    assert np.quantile(error, 0.999) < 1e-4, "embree computes in float32"


def test_clip_planes_cut_triangles_where_they_cross_them():
    mesh = still_life()
    camera = camera_at((1.0, 0.5, 4.0), fov=0.9, width=120, height=90)
    start, end = 3.4, 6.0
    got = nearest_triangles(mesh.triangles, camera, (start, end)).depth
    want = traced(mesh, camera, start)
    want[want > end] = np.inf
    assert (np.isfinite(want) == np.isfinite(got)).mean() > 0.999
    both = np.isfinite(want) & np.isfinite(got)
    assert np.quantile(np.abs(got[both] - want[both]), 0.999) < 1e-3
    assert got[np.isfinite(got)].min() >= start
    assert got[np.isfinite(got)].max() <= end


def test_a_closed_mesh_has_no_gaps_between_its_triangles():
    ball = trimesh.creation.icosphere(subdivisions=5)
    seen = nearest_triangles(ball.triangles, camera_at((0.0, 0.0, 6.0), fov=0.2, width=200, height=200)).depth
    assert np.isfinite(seen).all()
    assert seen.max() < 6, "no ray passes to the far side"


def test_a_skewed_and_shifted_camera_sees_what_its_rays_meet():
    mesh = still_life()
    camera = camera_at((1.0, 0.5, 4.0), fov=0.9, width=100, height=80)
    intrinsics = camera.intrinsics + torch.tensor([[5.0, 3.0, 20.0], [0, -4.0, -12.0], [0, 0, 0]])
    camera = Camera(intrinsics, camera.world_to_camera, 100, 80)
    got, want = nearest_triangles(mesh.triangles, camera).depth, traced(mesh, camera)
    both = np.isfinite(want) & np.isfinite(got)
    assert (np.isfinite(want) == np.isfinite(got)).mean() > 0.999
    assert np.quantile(np.abs(got[both] - want[both]) / want[both], 0.999) < 1e-4


def test_a_crop_is_the_part_of_the_picture():
    mesh = still_life()
    camera = camera_at((1.0, 0.5, 4.0), fov=0.9, width=100, height=80)
    whole = nearest_triangles(mesh.triangles, camera)
    part = nearest_triangles(mesh.triangles, camera.crop(30, 20, 50, 40))
    assert (part.triangle == whole.triangle[20:60, 30:80]).mean() > 0.9995
    assert np.allclose(part.depth, whole.depth[20:60, 30:80], rtol=1e-5)


def one_triangle(normal_up: float = 0.0) -> Solids:
    corners = np.array([[[-9, -9, 0], [9, -9, 0], [0, 9, 0]]], np.float32)
    return Solids(corners, np.array([[0.8, 0.4, 0.2]], np.float32), np.zeros(1, bool))


def test_a_wall_seen_head_on_has_the_headlight_and_half_the_sky():
    camera = camera_at((0.0, 0.0, 2.0), fov=0.01, width=3, height=3)
    solids = one_triangle()
    layer = shade_solids(solids, nearest_triangles(solids.corners, camera), camera)
    assert np.allclose(layer.rgb[1, 1], np.array([0.8, 0.4, 0.2]) * (HEADLIGHT + SKY / 2), atol=1e-4)
    from_behind = camera_at((0.0, 0.0, -2.0), fov=0.01, width=3, height=3)
    other = shade_solids(solids, nearest_triangles(solids.corners, from_behind), from_behind)
    assert np.allclose(other.rgb, layer.rgb, atol=1e-4), "both sides are seen"


def test_a_floor_has_its_own_colour_from_above_and_no_light_grows_it():
    floor = one_triangle().corners[:, :, [0, 2, 1]]
    solids = Solids(floor, np.ones((1, 3), np.float32), np.zeros(1, bool))
    above = look_at(torch.tensor([0.0, 3.0, 0.1]), torch.zeros(3), vertical_fov=0.01, width=3, height=3)
    assert np.allclose(shade_solids(solids, nearest_triangles(floor, above), above).rgb, 1, atol=2e-3)
    below = look_at(torch.tensor([0.0, -3.0, 0.1]), torch.zeros(3), vertical_fov=0.01, width=3, height=3)
    assert np.allclose(shade_solids(solids, nearest_triangles(floor, below), below).rgb, HEADLIGHT, atol=2e-3)


def test_a_holdout_is_empty_and_hides():
    both = np.concatenate([one_triangle().corners + np.float32([0, 0, 0.5]), one_triangle().corners])
    solids = Solids(both, np.ones((2, 3), np.float32), np.array([True, False]))
    camera = camera_at((0.0, 0.0, 2.0), fov=0.01, width=3, height=3)
    layer = shade_solids(solids, nearest_triangles(both, camera), camera)
    assert (layer.rgb == 0).all()
    assert (layer.alpha == 0).all()
    assert np.isinf(layer.depth).all()


def test_degenerate_triangles_and_none_at_all_are_no_error():
    line = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 0, 0], [0, 0, 0], [0, 0, 0]]], np.float32)
    camera = camera_at((0.0, 0.0, 2.0))
    assert (nearest_triangles(line, camera).triangle == -1).all()
    assert (nearest_triangles(line[:0], camera).triangle == -1).all()


def test_solids_of_wrong_shapes_or_with_nan_are_rejected_by_name():
    good = one_triangle()
    with refused(ValueError, "colour"):
        Solids(good.corners, good.colour[:, :2], good.holdout)
    with refused(ValueError, "NaN"):
        Solids(good.corners * np.float32(np.nan), good.colour, good.holdout)
