"""The script that makes the layout: its parts on meshes with known answers, its product against the shipped file."""

import math
import pathlib
import runpy
import sys

import numpy as np
import pytest
import torch
from primdiffusion.body.model import default_body
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.primitives import GRID

pytest.importorskip("igl", reason="libigl comes with the `bake` extra")
SCRIPT = pathlib.Path(__file__).parents[2] / "scripts/bake_layout"
sys.path.append(str(SCRIPT))

from charts import lay_out  # noqa: E402
from cutting import outline  # noqa: E402
from grid import chart_of_cells, draw  # noqa: E402
from half_body import FILLED, boundary_edges, left_half  # noqa: E402
from rectangle import Disc, flatten  # noqa: E402
from regions import cut_into_regions  # noqa: E402


def sheet_of(columns: int, rows: int, place=lambda s, t: (s, t, 0 * s)) -> tuple[np.ndarray, np.ndarray]:
    """A grid of triangles over [0, columns] x [0, rows], put into space by `place`."""
    s, t = (a.ravel().astype(float) for a in np.meshgrid(np.arange(columns + 1), np.arange(rows + 1)))
    row, column = (a.ravel() for a in np.mgrid[:rows, :columns])
    a = row * (columns + 1) + column
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return np.stack(place(s, t), -1), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def area(points: np.ndarray, faces: np.ndarray) -> float:
    p = points[faces]
    return float(np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum() / 2)


def test_a_developable_sheet_is_flattened_without_distortion():
    """A quarter of a tube of radius 1 and length 3, on a rectangle of its own proportions."""
    width, height = 8 * 2 * math.sin(math.pi / 32), 3.0

    def bent(s, t):
        angle = s / 8 * math.pi / 2
        return np.sin(angle), t / 6 * height, np.cos(angle)

    points, faces = sheet_of(8, 6, bent)
    disc = Disc(points, points, faces, np.arange(len(faces)))
    loop = outline(faces)
    flat = flatten(disc, loop, (0, 8, 62, 54), width, height)
    s, t = (a.ravel() for a in np.meshgrid(np.arange(9), np.arange(7)))
    expected = np.stack([s / 8 * width, t / 6 * height], -1)
    np.testing.assert_allclose(flat.uv[: len(points)], expected, atol=2e-3)


@pytest.mark.slow
def test_the_shipped_layout_is_what_the_script_makes():
    """Positions within half a millimetre: SLIM's last digits depend on the linear algebra library."""
    body = runpy.run_path(str(SCRIPT / "__main__.py"))["read_body"]()
    half = left_half(body.vertices, body.faces)
    assert (half.parent == FILLED).any()
    on_midline = half.midline[boundary_edges(half.faces)]
    assert on_midline.all()
    sheet, region = cut_into_regions(half, body.joints)
    cells = draw(body, sheet, region, lay_out(sheet, region), 1)
    made = (body.vertices[body.faces[cells.face]] * cells.barycentric[..., None]).sum(2)
    default = default_body()
    shipped = attach(default_anchors(), default.template, default.faces).position.reshape(GRID, GRID, 3)
    np.testing.assert_allclose(made, shipped.numpy(), atol=5e-4)
    assert torch.equal(default_anchors().chart, torch.from_numpy(chart_of_cells().ravel()))
