"""Draws the charts of the left half into the UV square and mirrors them to the right."""

from __future__ import annotations

import dataclasses

import numpy as np
from charts import PLACES
from half_body import FILLED, Sheet, mirror_vertices
from hand import project_hand
from numpy import ndarray as Array
from on_surface import barycentric_on, closest_on_faces
from primdiffusion.primitives.anchors import CHARTS
from primdiffusion.primitives.primitives import GRID
from primdiffusion.raster.uv_atlas import UvRaster, rasterise_uv
from rectangle import Flat
from regions import REGIONS
from scipy.ndimage import distance_transform_edt


@dataclasses.dataclass(frozen=True)
class Body:
    """The body's mesh."""

    vertices: Array
    """[V, 3] float64."""
    faces: Array
    """[F, 3] int64."""
    joints: dict[str, Array]


def draw(body: Body, sheet: Sheet, region: Array, flats: dict[str, Flat], samples: int) -> UvRaster:
    """The whole UV square with `samples` texels per side of a cell, every texel on the body."""
    height, width = GRID * samples, GRID * samples // 2
    face = np.full((height, width), -1)
    barycentric = np.zeros((height, width, 3))
    for name, place in PLACES.items():
        columns, rows = place.extent
        window = np.s_[
            place.row * samples : (place.row + rows) * samples,
            place.column * samples : (place.column + columns) * samples,
        ]
        if (face[window] >= 0).any():
            raise ValueError(f"the chart {name!r} overlaps another: correct PLACES")
        y, x = np.mgrid[window]
        of_region = np.unique(sheet.parent[(region == REGIONS.index(name)) & (sheet.parent != FILLED)])
        if name == "hand":
            uv = place.from_grid((np.stack([x, y], -1).reshape(-1, 2) + 0.5) / samples) / (place.width, place.height)
            found = project_hand(body.vertices, body.faces, of_region, uv)
        else:
            found = _draw_flat(body, flats[name], place.to_grid(flats[name].uv), of_region, (window, samples))
        face[window] = found[0].reshape(y.shape)
        barycentric[window] = found[1].reshape(*y.shape, 3)
    if (face < 0).any():
        raise ValueError(f"{(face < 0).mean():.1%} of the half grid is in no chart: correct PLACES")
    return _mirrored(body, UvRaster(face, barycentric))


def _draw_flat(
    body: Body, flat: Flat, on_grid: Array, of_region: Array, target: tuple[tuple[slice, slice], int]
) -> tuple[Array, Array]:
    """Body faces and coordinates of the texels in a chart's window."""
    (rows, columns), samples = target
    disc = flat.disc
    corner = (on_grid[disc.faces] * samples - (columns.start, rows.start)) / (
        columns.stop - columns.start,
        rows.stop - rows.start,
    )
    raster = rasterise_uv(corner, rows.stop - rows.start, columns.stop - columns.start)
    index = distance_transform_edt(~raster.covered, return_distances=False, return_indices=True)
    piece, weights = (a[tuple(index)].reshape(-1, *a.shape[2:]) for a in (raster.face, raster.barycentric))
    points = (disc.points[disc.faces[piece]] * weights[..., None]).sum(1)
    face = disc.parent[piece].copy()
    real = face != FILLED
    barycentric = np.zeros((len(face), 3))
    barycentric[real] = barycentric_on(body.vertices, body.faces, face[real], points[real])
    if not real.all():
        face[~real], barycentric[~real] = closest_on_faces(body.vertices, body.faces, of_region, points[~real])
    return face, barycentric


def _mirrored(body: Body, half: UvRaster) -> UvRaster:
    """The left half at u > 0.5 and its mirror image at u < 0.5."""
    opposite = mirror_vertices(body.vertices)
    index = {frozenset(face): i for i, face in enumerate(body.faces.tolist())}
    try:
        twin = np.array([index[frozenset(face)] for face in opposite[body.faces].tolist()])
    except KeyError as error:
        raise ValueError("the body has faces without a mirrored twin; bake it with its mirror step") from error
    corner = (opposite[body.faces][:, None, :] == body.faces[twin][:, :, None]).argmax(-1)
    face, barycentric = half.face[:, ::-1], half.barycentric[:, ::-1]
    mirrored = np.take_along_axis(barycentric, corner[face], axis=-1)
    return UvRaster(np.concatenate([twin[face], half.face], 1), np.concatenate([mirrored, half.barycentric], 1))


def chart_of_cells() -> Array:
    """[GRID, GRID] index into CHARTS; the person's left is at u > 0.5."""
    charts = np.full((GRID, GRID), -1)
    for name, place in PLACES.items():
        columns, rows = place.extent
        for side, start in (("left", GRID // 2 + place.column), ("right", GRID // 2 - place.column - columns)):
            full = name if name in CHARTS else f"{side}_{name}"
            charts[place.row : place.row + rows, start : start + columns] = CHARTS.index(full)
    return charts
