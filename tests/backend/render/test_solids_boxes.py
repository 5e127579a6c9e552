"""Boxes drawn as boxes: against every ray tried on every box."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from march_scenes import camera_at, one_box, random_boxes
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.solids import EDGE_LIGHT, LIT, box_colours, draw_boxes


def every_hit(boxes: Primitives, camera: Camera, start: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [h, w] of the first surface of a box behind the depth `start`, that box, and |n . ray| there."""
    origin, rays = (value.double().numpy() for value in camera.rays())
    position, rotation, half = (getattr(boxes, n).double().numpy() for n in ("position", "rotation", "half_extent"))
    axis = camera.world_to_camera[2, :3].double().numpy()
    o = np.einsum("kji,kj->ki", rotation, origin - position) / half
    d = np.einsum("kji,hwj->hwki", rotation, rays) / half
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.stack([(-1 - o) / d, (1 - o) / d])
    enter, leave = np.nanmin(crossing, 0).max(-1), np.nanmax(crossing, 0).min(-1)
    which = np.nanmin(crossing, 0).argmax(-1), np.nanmax(crossing, 0).argmin(-1)
    cosine = (rays @ axis)[..., None]
    met = (enter <= leave) & (leave > 0)
    near = np.where(met & (enter * cosine >= start), enter, np.where(met & (leave * cosine >= start), leave, np.inf))
    box = near.argmin(-1)
    rows, columns = np.indices(box.shape)
    face = np.where(near == enter, which[0], which[1])[rows, columns, box]
    facing = np.abs((rotation[box, :, face] * rays).sum(-1))
    return near[rows, columns, box] * cosine[..., 0], np.where(np.isfinite(near.min(-1)), box, -1), facing


@pytest.mark.parametrize(("seed", "start"), [(1, 0.0), (2, 0.0), (3, 0.45)])
def test_each_pixel_shows_the_nearest_box(seed, start):
    boxes = random_boxes(60, seed, spread=0.12)
    camera = camera_at((0.1, 0.25, 0.5), fov=0.6, width=60, height=44)
    depth, box, _ = every_hit(boxes, camera, start)
    drawn = draw_boxes(boxes, camera, clip=(start, math.inf))
    seen = box >= 0
    assert 0.2 < seen.mean() < 0.98
    assert (drawn.alpha == seen).mean() > 0.998, "but for silhouettes that pass through a pixel's centre"
    both = seen & (drawn.alpha > 0)
    assert np.quantile(np.abs(drawn.depth[both] - depth[both]), 0.995) < 1e-6
    hue = drawn.rgb / drawn.rgb.max(-1, keepdims=True).clip(1e-9)
    colours = box_colours(60)
    want = (colours / colours.max(-1, keepdims=True))[box]
    assert (np.abs(hue - want).max(-1) < 1e-4)[both].mean() > 0.99


def test_faces_are_lit_by_how_they_are_turned_and_lines_run_along_edges():
    boxes = random_boxes(12, 4, spread=0.05)
    camera = camera_at((0.0, 0.1, 0.5), fov=0.4, width=160, height=160)
    _, box, facing = every_hit(boxes, camera)
    drawn = draw_boxes(boxes, camera)
    seen = (box >= 0) & (drawn.alpha > 0)
    light = (drawn.rgb / box_colours(12)[box]).mean(-1) / (LIT[0] + LIT[1] * facing)
    full = np.abs(light - 1) < 1e-3
    assert 0.6 < full[seen].mean() < 0.97
    dark = np.abs(light - EDGE_LIGHT) < 1e-3
    assert 0.01 < dark[seen].mean() < 0.3
    assert ((light > EDGE_LIGHT - 1e-3) & (light < 1 + 1e-3))[seen].mean() > 0.998


def test_inside_a_box_its_walls_are_seen_and_a_box_behind_the_camera_is_not():
    box = one_box(0.5)
    inside = draw_boxes(box, camera_at((0.0, 0.0, 0.2), fov=1.2))
    assert (inside.alpha == 1).all()
    assert np.allclose(inside.depth[10, 12], 0.7, atol=0.05)
    behind = dataclasses.replace(box, position=torch.tensor([[0.0, 0.0, 5.0]]).double())
    assert (draw_boxes(behind, camera_at((0.0, 0.0, 2.0))).alpha == 0).all()


def test_a_clip_plane_opens_a_box():
    box, camera = one_box(0.1), camera_at((0.0, 0.0, 1.0), fov=0.1)
    assert np.allclose(draw_boxes(box, camera).depth[10, 12], 0.9, atol=1e-3)
    assert np.allclose(draw_boxes(box, camera, clip=(1.0, math.inf)).depth[10, 12], 1.1, atol=1e-3)
    assert (draw_boxes(box, camera, clip=(0.1, 0.85)).alpha == 0).all()


def test_boxes_of_a_group_share_a_hue_and_none_shares_its_colour():
    group = torch.tensor([0, 0, 0, 1, 1, 1])
    colours = box_colours(6, group)
    order = colours.argsort(-1)
    assert (order[:3] == order[0]).all()
    assert (order[3:] == order[3]).all()
    assert (order[0] != order[3]).any()
    assert len(np.unique(colours, axis=0)) == 6


def test_mirrored_boxes_give_the_mirrored_picture_and_flat_ones_none():
    boxes = random_boxes(20, 5)
    camera = camera_at((0.0, 0.1, 0.6), fov=0.5, width=41, height=40)
    mirror = torch.diag(torch.tensor([-1.0, 1, 1])).double()
    mirrored = dataclasses.replace(boxes, position=boxes.position @ mirror, rotation=mirror @ boxes.rotation)
    picture, other = draw_boxes(boxes, camera), draw_boxes(mirrored, camera)
    assert (np.abs(picture.rgb[:, ::-1] - other.rgb).max(-1) < 1e-3).mean() > 0.995
    flat = dataclasses.replace(boxes, half_extent=boxes.half_extent * torch.tensor([1.0, 0.0, 1.0]))
    assert (draw_boxes(flat, camera).alpha == 0).all()
