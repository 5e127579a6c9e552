"""Measures a layout: whether it is on the body, even and symmetric, and its boxes contain the skin and clothes."""

from __future__ import annotations

import numpy as np
import torch
from numpy import ndarray as Array
from primdiffusion.geometry.surface import surface_points, vertex_normals
from primdiffusion.primitives.anchors import CHARTS, Anchors, attach, tangent_plane
from primdiffusion.primitives.primitives import GRID, Frames
from primdiffusion.raster.uv_atlas import UvRaster
from scipy.spatial import cKDTree

SAMPLES = 20_000
PUSHED_OUT = (0.0, 0.02, 0.04, 0.06)
"""Distances from the skin in metres at which clothes and hair must still be in a box."""

CORE = 0.8
"""Share of a half extent that counts as inside; farther out, the marcher's window has dropped to a quarter."""


def measure(anchors: Anchors, vertices: torch.Tensor, faces: torch.Tensor, texels: UvRaster) -> dict[str, float]:
    """The figures by name; lengths in millimetres. `vertices` are the rest shape, float64."""
    frames = attach(anchors, vertices, faces)
    position, rotation = frames.position.numpy(), frames.rotation.numpy()
    du, dv = (edge.norm(dim=-1).numpy() * 1e3 for edge in tangent_plane(anchors, vertices))
    points, normals = _sampled_surface(vertices, faces, SAMPLES)
    distance = cKDTree(position).query(points)[0] * 1e3
    grid = position.reshape(GRID, GRID, 3)
    agreement = (rotation[:, :, 2] * _footprint_normals(vertices, faces, texels)).sum(-1)
    table = {
        "cells_on_body_share": float((anchors.barycentric >= 0).all(-1).double().mean()),
        "symmetry_error_max_mm": float(np.abs(grid - grid[:, ::-1] * (-1, 1, 1)).max() * 1e3),
        "flipped_frames": int((agreement <= 0).sum()),
        "normal_to_footprint_max_degrees": float(np.degrees(np.arccos(agreement.min()))),
        "shear_p95_degrees": float(np.percentile(_shear(anchors, vertices), 95)),
        "coincident_cells": int((cKDTree(position).query(position, k=2)[0][:, 1] < 5e-3).sum()),
        "surface_to_primitive_mean_mm": float(distance.mean()),
        "surface_to_primitive_p95_mm": float(np.percentile(distance, 95)),
        "surface_to_primitive_max_mm": float(distance.max()),
    }
    chart = anchors.chart.numpy()
    near = chart[cKDTree(position).query(points)[1]]
    for region in ("torso", "head", "arm", "hand", "leg", "foot"):
        members = [i for i, name in enumerate(CHARTS) if name.endswith(region)]
        cells, surface = np.isin(chart, members), np.isin(near, members)
        both = np.concatenate([du[cells], dv[cells]])
        table |= {
            f"{region}_cells_share": float(cells.mean()),
            f"{region}_area_share": float(surface.mean()),
            f"{region}_spacing_u_mean_mm": float(du[cells].mean()),
            f"{region}_spacing_v_mean_mm": float(dv[cells].mean()),
            f"{region}_spacing_min_mm": float(both.min()),
            f"{region}_spacing_max_mm": float(both.max()),
            f"{region}_surface_to_primitive_mean_mm": float(distance[surface].mean()),
            f"{region}_surface_to_primitive_max_mm": float(distance[surface].max()),
        }
    for offset in PUSHED_OUT:
        count = boxes_over(points + offset * normals, frames)
        table[f"in_a_box_at_{offset * 1e3:.0f}mm_share"] = float((count > 0).mean())
        table[f"boxes_a_point_at_{offset * 1e3:.0f}mm"] = float(count.mean())
    return table


def boxes_over(points: Array, frames: Frames) -> Array:
    """[n] the number of boxes whose core contains each point."""
    position, rotation, half_extent = (a.numpy() for a in (frames.position, frames.rotation, frames.half_extent))
    count = np.zeros(len(points), dtype=int)
    tree = cKDTree(points)
    for k in range(len(position)):
        near = np.array(tree.query_ball_point(position[k], np.linalg.norm(half_extent[k])), dtype=int)
        local = (points[near] - position[k]) @ rotation[k]
        count[near[(np.abs(local) < CORE * half_extent[k]).all(-1)]] += 1
    return count


def _footprint_normals(vertices: torch.Tensor, faces: torch.Tensor, texels: UvRaster) -> Array:
    """[K, 3] mean unit normal of the surface that a cell covers."""
    barycentric = torch.from_numpy(texels.barycentric.reshape(-1, 3))
    normals = surface_points(
        vertex_normals(vertices, faces), faces, torch.from_numpy(texels.face.ravel()), barycentric
    ).numpy()
    side = texels.face.shape[0] // GRID
    mean = normals.reshape(GRID, side, GRID, side, 3).mean((1, 3)).reshape(-1, 3)
    return mean / np.linalg.norm(mean, axis=-1, keepdims=True)


def _shear(anchors: Anchors, vertices: torch.Tensor) -> Array:
    """[K] degrees by which the angle between the two sides of a cell differs from a right angle."""
    du, dv = tangent_plane(anchors, vertices)
    cosine = torch.nn.functional.cosine_similarity(du, dv, dim=-1)
    return np.degrees(np.arcsin(cosine.abs().clamp(max=1).numpy()))


def _sampled_surface(vertices: torch.Tensor, faces: torch.Tensor, number: int) -> tuple[Array, Array]:
    """Deterministic points spread evenly by area, and the normals there."""
    generator = np.random.default_rng(0)
    p, f = vertices.numpy(), faces.numpy()
    area = np.linalg.norm(np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]]), axis=1)
    face = generator.choice(len(f), number, p=area / area.sum())
    weights = generator.dirichlet(np.ones(3), number)
    normals = vertex_normals(vertices, faces).numpy()
    normal = np.einsum("nk,nkc->nc", weights, normals[f[face]])
    return np.einsum("nk,nkc->nc", weights, p[f[face]]), normal / np.linalg.norm(normal, axis=1, keepdims=True)
