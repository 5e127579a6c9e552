"""Anchors for any body with a UV map, by the paper's rule and by that of the released code."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.formats.body_layout import NORMAL_HALF_EXTENT, SPACING_TO_HALF_EXTENT
from primdiffusion.primitives.anchors import (
    CHARTS,
    JOINT_REGION,
    attach,
    build_anchors,
    footprint_anchors,
    grid_points_outside,
    released_half_extent,
    tangent_plane,
)
from primdiffusion.primitives.primitives import GRID, K
from primdiffusion.raster.uv_atlas import rasterise_uv
from support.errors import refused

RADIUS, HEIGHT, SEGMENTS = 0.3, 1.2, 64


def cylinder(u_from: float = 0.0, u_to: float = 1.0, mirrored: bool = False) -> BodyModel:
    """An open tube about y: u runs once round it (from z towards x), v from bottom to top."""
    u, v = np.meshgrid(np.linspace(0, 1, SEGMENTS + 1), np.linspace(0, 1, 9))
    angle = 2 * math.pi * u
    points = np.stack([RADIUS * np.sin(angle), HEIGHT * v, RADIUS * np.cos(angle)], -1).reshape(-1, 3)
    painted = np.stack([u_from + (u_to - u_from) * (1 - u if mirrored else u), v], -1).reshape(-1, 2)
    row, column = (index.ravel() for index in np.mgrid[:8, :SEGMENTS])
    a = row * (SEGMENTS + 1) + column
    b, c, d = a + 1, a + SEGMENTS + 2, a + SEGMENTS + 1
    faces = torch.from_numpy(np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    count = len(points)
    weights = torch.zeros(count, 24, dtype=torch.float64)
    weights[:, 16] = 1
    return BodyModel(
        template=torch.from_numpy(points),
        shape_basis=torch.zeros(count, 3, 1, dtype=torch.float64),
        pose_basis=torch.zeros(count, 3, 0, dtype=torch.float64),
        joint_regressor=torch.full((24, count), 1 / count, dtype=torch.float64),
        skin_weights=weights,
        parents=torch.arange(-1, 23),
        faces=faces,
        uv=torch.from_numpy(painted),
        uv_faces=faces,
    )


def test_frames_on_a_cylinder_are_its_tangents_and_radii():
    body = cylinder()
    frames = attach(build_anchors(body), body.template, body.faces)
    u = (torch.arange(GRID, dtype=torch.float64) * 8 + 4.5) / 256
    segment = torch.floor(u * SEGMENTS) + 0.5
    angle = (2 * math.pi * segment / SEGMENTS).repeat(GRID)
    zero, one = torch.zeros(K, dtype=torch.float64), torch.ones(K, dtype=torch.float64)
    round_about = torch.stack([angle.cos(), zero, -angle.sin()], -1)
    outward = torch.stack([angle.sin(), zero, angle.cos()], -1)
    up = torch.stack([zero, one, zero], -1)
    assert torch.allclose(frames.rotation, torch.stack([round_about, up, outward], -1), atol=1e-9)
    v = ((torch.arange(GRID, dtype=torch.float64) * 8 + 4.5) / 256).repeat_interleave(GRID)
    assert torch.allclose(frames.position[:, 1], HEIGHT * v, atol=1e-9)


def test_in_plane_sizes_come_from_the_uv_gradient():
    body = cylinder()
    anchors = build_anchors(body)
    du, dv = tangent_plane(anchors, body.template)
    chord = SEGMENTS * 2 * RADIUS * math.sin(math.pi / SEGMENTS)
    assert torch.allclose(du.norm(dim=-1), torch.full((K,), chord / GRID, dtype=torch.float64))
    assert torch.allclose(dv.norm(dim=-1), torch.full((K,), HEIGHT / GRID, dtype=torch.float64))
    expected = torch.tensor(
        [0.05, SPACING_TO_HALF_EXTENT * HEIGHT / GRID, NORMAL_HALF_EXTENT["arm"]], dtype=torch.float64
    )
    assert torch.allclose(anchors.rest_half_extent, expected.expand(K, 3))


def test_normals_point_outward_on_mirrored_charts_and_inside_out_meshes():
    for body in (cylinder(mirrored=True), dataclasses.replace(cylinder(), faces=cylinder().faces.flip(1))):
        body = dataclasses.replace(body, uv_faces=body.faces)
        frames = attach(build_anchors(body), body.template, body.faces)
        radial = frames.position * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
        assert ((frames.rotation[..., 2] * radial).sum(-1) > 0).all()


def test_cells_outside_the_charts_take_the_closest_chart_point():
    """The chart covers u < 0.5, so every cell of the right half belongs to the seam at its own height."""
    body = cylinder(0.0, 0.5)
    frames = attach(build_anchors(body), body.template, body.faces)
    right = (torch.arange(K) % GRID) >= GRID // 2
    v = ((torch.arange(GRID, dtype=torch.float64) * 8 + 4.5) / 256).repeat_interleave(GRID)
    seam = torch.stack([torch.zeros(K), HEIGHT * v, torch.full((K,), RADIUS)], -1).double()
    assert torch.allclose(frames.position[right], seam[right], atol=1e-9)


def test_the_released_rule_puts_cells_outside_the_charts_on_the_last_face():
    body = cylinder(0.0, 0.5)
    anchors = build_anchors(body, "released")
    right = (torch.arange(K) % GRID) >= GRID // 2
    assert (anchors.face[right] == len(body.faces) - 1).all()
    assert not (anchors.face[~right] == len(body.faces) - 1).all()
    assert torch.allclose(anchors.rest_half_extent[right], torch.tensor(0.005 * 2 / 3, dtype=torch.float64))
    assert int(right.sum()) == grid_points_outside(body)
    frames = attach(anchors, body.template, body.faces)
    assert torch.isfinite(frames.rotation).all()


def test_cells_outside_the_charts_take_the_place_in_the_face_of_the_nearest_covered_texel():
    """A search over all 256 x 256 texels (SPEC 1.2), by corners that any point of the right half is nearest to."""
    body = cylinder(0.0, 0.5)
    anchors = build_anchors(body, "released")
    raster = rasterise_uv(body.uv[body.uv_faces].double().numpy(), 256, 256)
    rows, columns = np.nonzero(raster.face >= 0)
    outside = [k for k in range(K) if raster.face[8 * (k // GRID) + 4, 8 * (k % GRID) + 4] < 0]
    assert len(outside) == grid_points_outside(body) > 0
    for k in outside[:: len(outside) // 40]:
        distance = (rows - (8 * (k // GRID) + 4)) ** 2 + (columns - (8 * (k % GRID) + 4)) ** 2
        nearest = np.flatnonzero(distance == distance.min())
        among = raster.barycentric[rows[nearest], columns[nearest]]
        found = anchors.barycentric[k].double().numpy()
        assert anchors.face[k] == len(body.faces) - 1
        assert np.abs(among - found).max(1).min() < 1e-6


def test_released_sizes_are_two_thirds_of_the_mean_distance_to_23_neighbours():
    position = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    extent = released_half_extent(position)
    for k in (0, 57, 199):
        others = sorted(math.dist(position[k].tolist(), position[j].tolist()) for j in range(200) if j != k)
        expected = min(max(sum(others[:23]) / 23, 0.005), 0.050) * 2 / 3
        assert extent[k].tolist() == pytest.approx([expected] * 3, rel=1e-5)


def test_released_sizes_are_clipped_at_both_ends():
    crowded = released_half_extent(torch.zeros(30, 3))
    lonely = released_half_extent(10 * torch.eye(30)[:, :3] + torch.arange(30.0)[:, None])
    assert torch.allclose(crowded, torch.tensor(0.01 / 3))
    assert torch.allclose(lonely, torch.tensor(0.1 / 3))


def test_a_face_without_area_in_uv_still_has_a_frame():
    body = cylinder()
    uv = body.uv.clone()
    uv[:, 0] = 0.25
    uv[0, 0] = 1.0
    squeezed = dataclasses.replace(body, uv=uv)
    frames = attach(build_anchors(squeezed), squeezed.template, squeezed.faces)
    assert torch.allclose(torch.linalg.det(frames.rotation), torch.ones(K, dtype=torch.float64))


def test_a_footprint_is_the_whole_cell_and_agrees_with_the_uv_gradient_on_a_cylinder():
    """Footprints smooth over one cell, 11 degrees wide: directions agree, a chord is shorter than its arc."""
    body = cylinder()
    gradient = build_anchors(body)
    texels = rasterise_uv(body.uv[body.uv_faces].numpy(), 256, 256)
    footprint = footprint_anchors(
        body.template,
        body.faces,
        gradient.face,
        gradient.barycentric,
        gradient.chart,
        torch.from_numpy(texels.face),
        torch.from_numpy(texels.barycentric),
    )
    du, dv = tangent_plane(footprint, body.template)
    width = 2 * math.pi * RADIUS / GRID
    assert torch.allclose(du.norm(dim=-1), torch.full((K,), width, dtype=torch.float64), rtol=1e-2)
    assert torch.allclose(dv.norm(dim=-1), torch.full((K,), HEIGHT / GRID, dtype=torch.float64), rtol=1e-6)
    by_cell = attach(footprint, body.template, body.faces).rotation
    by_face = attach(gradient, body.template, body.faces).rotation
    angle = ((by_cell.mT @ by_face).diagonal(dim1=-2, dim2=-1).sum(-1) / 2 - 0.5).clamp(-1, 1).arccos()
    assert float(angle.max()) < math.pi / SEGMENTS + 1e-3


def test_charts_come_from_the_joints_that_move_the_skin():
    body = cylinder()
    anchors = build_anchors(body)
    assert (anchors.chart == CHARTS.index(JOINT_REGION[16])).all()
    assert JOINT_REGION[16] == "left_arm"


def test_the_default_bodys_skin_uv_gives_finite_frames_that_point_outward():
    body = default_body()
    anchors = build_anchors(body)
    frames = attach(anchors, body.template, body.faces)
    assert torch.allclose(torch.linalg.det(frames.rotation), torch.ones(K), atol=1e-5)
    corner = body.template[body.faces[anchors.face]]
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert ((frames.rotation[..., 2] * normal).sum(-1) > 0).all()


def test_a_body_without_uv_is_rejected_with_the_remedy():
    body = dataclasses.replace(cylinder(), uv=torch.zeros(0, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match="load it with a UV map"):
        build_anchors(body)


def test_a_template_that_is_not_finite_is_rejected():
    body = cylinder()
    template = body.template.clone()
    template[0, 0] = torch.inf
    with refused(ValueError, "body"):
        build_anchors(dataclasses.replace(body, template=template))


def test_an_unknown_rule_is_rejected():
    with pytest.raises((ValueError, TypeError)):
        build_anchors(cylinder(), "other")  # type: ignore[arg-type]
