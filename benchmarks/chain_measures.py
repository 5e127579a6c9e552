"""What benchmarks/chain.py measures on pictures, payloads, latents and skin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from primdiffusion.body.model import default_body
from primdiffusion.diffusion.codec import window_weight
from primdiffusion.editing.regions import region_of
from primdiffusion.evaluation.image_metrics import compare_detail, figure_psnr, overlap, ssim
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.primitives.anchors import CHARTS, attach, default_anchors
from primdiffusion.primitives.primitives import Payload, S
from torch import Tensor

SHEET_SIDE = 256
"""Pixels a side of each picture of the sheet."""
GREY = 0.5
"""sRGB-encoded background of all pictures."""
VISIBLE_ALPHA = 0.9
"""Pixels less opaque than this are not read for skin colours."""
FACING = 0.5
"""Cosine between a cell's normal and the way to the camera above which its pixel is read for skin colours."""
BARE = 20.0
"""CIE Lab: a forearm farther than this from the hands' colour wears a sleeve."""
SKIN_PARTS = ("face", "forearms", "hands")
XYZ_OF_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Of linear sRGB (IEC 61966-2-1); its rows' sums are the white point D65."""

Measures = Mapping[str, float]


def over_grey(rgba: Float[Tensor, "H W 4"]) -> Float[Tensor, "H W 3"]:
    """The encoded picture over GREY of linear colour premultiplied by alpha."""
    background = decode_srgb(torch.tensor(GREY))
    return encode_srgb((rgba[..., :3] + (1 - rgba[..., 3:]) * background).clamp(0, 1))


def compare(drawn: Float[Tensor, "H W 4"], true: Float[Tensor, "H W 4"]) -> Measures:
    """psnr (dB, over the figure and a margin), ssim, iou, hf and cor of a picture against the true one."""
    image, target = over_grey(drawn), over_grey(true)
    figure, true_figure = drawn[..., 3] > 0.5, true[..., 3] > 0.5
    detail = compare_detail(image, figure, target, true_figure)
    return {
        "psnr": float(figure_psnr(image, target, true_figure)),
        "ssim": float(ssim(image, target)),
        "iou": overlap(figure, true_figure),
        "hf": 0.0 if detail is None else detail.energy,
        "cor": 0.0 if detail is None else detail.correlation,
    }


def means(rows: Sequence[Measures]) -> dict[str, float]:
    """Of each measure over pictures."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def change_cosine(first: Payload, second: Payload, start: Payload, full_density: float) -> float:
    """Cosine of the changes of two fits from their start: encoded colour and relative density, weighted by the window.

    1: both found the same; 0: what they changed is chance.
    """
    root = window_weight()[: S**3].unflatten(0, (S, S, S))

    def values(payload: Payload) -> Tensor:
        colour = encode_srgb(payload.rgb.clamp(0, 1)) * root
        return torch.cat([colour.flatten(), (payload.density / full_density * root).flatten()]).double()

    origin = values(start)
    return float(torch.nn.functional.cosine_similarity(values(first) - origin, values(second) - origin, dim=0))


def rest_std(rest: Float[Tensor, "n c 32 32"]) -> dict[str, float]:
    """Root mean square by region of the body of what person components leave out."""
    cells, chart = rest.flatten(2), default_anchors().chart
    return {name: float(cells[..., chart == number].square().mean().sqrt()) for number, name in enumerate(CHARTS)}


def skin_colours(rgba: Float[Tensor, "H W 4"], camera: Camera, betas: Tensor) -> dict[str, Float[ndarray, "3"]]:
    """CIE Lab of face, forearms and hands: the median of the pixels on which their cells' anchors fall.

    Cells that face away from the camera and pixels with less than VISIBLE_ALPHA are left out; so is a part without any.
    """
    body, anchors = default_body(), default_anchors()
    frames = attach(anchors, body.shape(betas.to(body.template.dtype)).vertices, body.faces)
    way = torch.nn.functional.normalize(camera.position - frames.position, dim=-1)
    facing = (frames.rotation[..., 2] * way).sum(-1) > FACING
    places, _ = camera.project(frames.position)
    column, row = places.long().clamp_min(0).unbind(-1)
    pixel = rgba[row.clamp_max(camera.height - 1), column.clamp_max(camera.width - 1)]
    seen = facing & (pixel[:, 3] > VISIBLE_ALPHA)
    colours = {}
    for part in SKIN_PARTS:
        chosen = pixel[seen & region_of([part])]
        if len(chosen):
            lab = lab_of_linear((chosen[:, :3] / chosen[:, 3:]).numpy())
            colours[part] = np.median(lab, axis=0)
    return colours


def lab_of_linear(rgb: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """CIE L*a*b* (D65) of linear sRGB."""
    ratio = rgb.clip(0, 1).astype(np.float64) @ XYZ_OF_RGB.T / XYZ_OF_RGB.sum(1)
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def skin_differences(people: Sequence[Mapping[str, ndarray]]) -> dict[str, list[float]]:
    """Lab distance of the face to forearms (bare ones alone) and to hands, person by person."""
    differences: dict[str, list[float]] = {"forearm": [], "hands": []}
    for colours in people:
        if "face" not in colours or "hands" not in colours:
            continue
        face, hands = colours["face"], colours["hands"]
        differences["hands"].append(float(np.linalg.norm(face - hands)))
        forearms = colours.get("forearms")
        if forearms is not None and np.linalg.norm(forearms - hands) < BARE:
            differences["forearm"].append(float(np.linalg.norm(face - forearms)))
    return differences


def skin_figures(
    made: Mapping[str, Sequence[float]], real: Mapping[str, Sequence[float]]
) -> dict[str, float | int | None]:
    """Mean and 90th percentile of differences, and what share of held-out people's they are."""
    figures: dict[str, float | int | None] = {}
    for part, suffix in (("forearm", ""), ("hands", "_hands")):
        few = not made[part] or not real[part]
        for name, statistic in (("", np.mean), ("_p90", lambda values: np.percentile(values, 90))):
            ours, theirs = (None, None) if few else (float(statistic(made[part])), float(statistic(real[part])))
            figures[f"skin{suffix}_difference{name}"] = ours
            figures[f"skin{suffix}_difference{name}_held"] = theirs
            figures[f"skin{suffix}_difference{name}_ratio"] = None if ours is None else ours / max(theirs or 0.0, 1e-6)
        figures[f"skin{suffix}_people"], figures[f"skin{suffix}_people_held"] = len(made[part]), len(real[part])
    return figures


def save_sheet(people: Sequence[Mapping[str, tuple[Tensor, Tensor]]], path: Path) -> None:
    """Heads, then fronts, at each stage; a row per person."""
    rows = []
    for stages in people:
        cells = [pair[part] for part in (0, 1) for pair in stages.values()]
        images = [Image.fromarray((cell.numpy() * 255).round().astype(np.uint8)) for cell in cells]
        rows.append(np.concatenate([np.asarray(image.resize((SHEET_SIDE, SHEET_SIDE))) for image in images], axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path, optimize=True)
