"""Metrics of pictures with one human: PSNR around the figure, and fine detail. Images are sRGB-encoded, in [0, 1]."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from primdiffusion.evaluation.metrics import psnr
from scipy import ndimage
from torch import Tensor

FIGURE_MARGIN = 8
"""Pixels around a figure that count in `figure_psnr`: what sticks out of its outline is an error too."""
FINE_SIGMA = 3.0
"""Pixels: fine detail is what a Gaussian blur of this standard deviation removes."""
OUTLINE = 4
"""Pixels within the outline that `detail_energy` and `compare_detail` leave out: edges there are not detail."""
LUMA = (0.299, 0.587, 0.114)


def figure_psnr(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], figure: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """PSNR over the target's figure and FIGURE_MARGIN pixels around it, dB. Raises ValueError for an empty figure."""
    if not figure.any():
        raise ValueError("the target shows no figure: there is nothing to compare")
    near = torch.from_numpy(ndimage.binary_dilation(figure.numpy(), iterations=FIGURE_MARGIN))
    return psnr(image[near][None], target[near][None])


class Detail(NamedTuple):
    """Fine detail of a picture beside that of the true one."""

    energy: float
    """Over the true one's; above 1 is noise or aliasing, unless the correlation is high too."""
    correlation: float
    """From -1 to 1."""


def compare_detail(
    image: Float[Tensor, "H W 3"],
    figure: Bool[Tensor, "H W"],
    target: Float[Tensor, "H W 3"],
    target_figure: Bool[Tensor, "H W"],
) -> Detail | None:
    """Detail finer than FINE_SIGMA inside both figures; None where these have no inside in common."""
    inside = _inside(figure & target_figure)
    if not inside.any():
        return None
    ours, true = (_fine(one, mask)[inside] for one, mask in ((image, figure), (target, target_figure)))
    ours_energy, true_energy = float((ours**2).mean()), float((true**2).mean())
    product = float((ours * true).mean())
    return Detail(ours_energy / max(true_energy, 1e-9), product / max((ours_energy * true_energy) ** 0.5, 1e-9))


def detail_energy(image: Float[Tensor, "H W 3"], figure: Bool[Tensor, "H W"]) -> float | None:
    """Mean square of the detail finer than FINE_SIGMA inside the figure; None where it has no inside."""
    inside = _inside(figure)
    return float((_fine(image, figure)[inside] ** 2).mean()) if inside.any() else None


def _inside(figure: Bool[Tensor, "H W"]) -> Bool[np.ndarray, "H W"]:
    return ndimage.binary_erosion(figure.numpy(), iterations=OUTLINE)


def _fine(image: Float[Tensor, "H W 3"], figure: Bool[Tensor, "H W"]) -> Float[np.ndarray, "H W"]:
    """Brightness less its blur, which sees the figure alone: the background is no detail."""
    brightness, weight = image.double().numpy() @ np.array(LUMA), figure.double().numpy()
    seen = np.maximum(ndimage.gaussian_filter(weight, FINE_SIGMA), 1e-3)
    return brightness - ndimage.gaussian_filter(brightness * weight, FINE_SIGMA) / seen
