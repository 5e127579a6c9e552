"""Bake the layout of the default body's primitives: `python scripts/bake_layout` (the `bake` extra; under a minute)."""

from __future__ import annotations

import io
import json
import os
import pathlib
import platform

import numpy as np
import torch
from charts import lay_out
from grid import Body, chart_of_cells, draw
from half_body import left_half
from metrics import measure
from picture import draw_figure
from primdiffusion.primitives.anchors import footprint_anchors
from primdiffusion.primitives.primitives import S
from primdiffusion.raster.uv_atlas import UvRaster
from regions import cut_into_regions

ROOT = pathlib.Path(__file__).parents[2]
LAYOUT = ROOT / "backend/primdiffusion/body/data/layout.npz"
RESULTS = ROOT / "docs/results/layout.json"
FIGURE = ROOT / "docs/pictures/layout.png"


def main() -> None:
    body = read_body()
    sheet, region = cut_into_regions(left_half(body.vertices, body.faces), body.joints)
    flats = lay_out(sheet, region)
    cells, texels = (draw(body, sheet, region, flats, samples) for samples in (1, S))
    write_layout(cells, texels)

    vertices, faces = torch.from_numpy(body.vertices), torch.from_numpy(body.faces)
    anchors = footprint_anchors(
        vertices,
        faces,
        torch.from_numpy(cells.face.ravel()),
        torch.from_numpy(cells.barycentric.reshape(-1, 3)),
        torch.from_numpy(chart_of_cells().ravel()),
        torch.from_numpy(texels.face),
        torch.from_numpy(texels.barycentric),
    )
    table = measure(anchors, vertices, faces, texels)
    for name, value in table.items():
        print(f"{name:44s} {value:10.3f}")
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    versions = {"numpy": np.__version__, "torch": torch.__version__, "python": platform.python_version()}
    rounded = {name: round(value, 4) for name, value in table.items()}
    _write(RESULTS, (json.dumps({**rounded, **versions}, indent=1) + "\n").encode())
    FIGURE.parent.mkdir(parents=True, exist_ok=True)
    _write(FIGURE, draw_figure(anchors, texels, vertices, faces))


def read_body() -> Body:
    with np.load(ROOT / "backend/primdiffusion/body/data/body.npz") as stored:
        joints = dict(zip(stored["joint_names"].tolist(), stored["J"].astype(np.float64), strict=True))
        return Body(stored["v_template"].astype(np.float64), stored["f"].astype(np.int64), joints)


def write_layout(cells: UvRaster, texels: UvRaster) -> None:
    """Write layout.npz: cells in full precision; of texels the first two coordinates, in steps of 1/65535."""
    file = io.BytesIO()
    np.savez_compressed(
        file,
        cell_face=cells.face.ravel().astype(np.uint16),
        cell_barycentric=cells.barycentric.reshape(-1, 3).astype(np.float32),
        cell_chart=chart_of_cells().ravel().astype(np.uint8),
        texel_face=texels.face.astype(np.uint16),
        texel_barycentric=np.round(texels.barycentric[..., :2] * 65535).astype(np.uint16),
    )
    _write(LAYOUT, file.getvalue())


def _write(path: pathlib.Path, content: bytes) -> None:
    temporary = path.with_suffix(".part")
    temporary.write_bytes(content)
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
