"""Cut a person out of a photograph, by GrabCut from the outline of a body that is posed over it.

Rother, Kolmogorov, Blake: "GrabCut": interactive foreground extraction using iterated graph cuts, 2004. OpenCV does it,
from the optional extra `primdiffusion[cutout]`.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

INNER, OUTER = 0.018, 0.045
"""Widths of the bands within and around the outline in which it is sought, as shares of its height."""
ITERATIONS = 5


def load_opencv() -> Any:
    """The module cv2. Raises ValueError if it is not installed."""
    try:
        import cv2
    except ImportError as e:
        raise ValueError(
            'the picture has neither alpha nor a mask: give one, or install "primdiffusion[cutout]" (OpenCV), which '
            "cuts out the person over whom a body is posed"
        ) from e
    return cv2


def cut_out(pixels: UInt8[np.ndarray, "H W 3"], outline: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """The person's mask, 0 or 255, near the outline of a body with usual clothes; 0 where there is no outline.

    Deterministic. What is not connected with the inside of the outline is not the person. Raises as `load_opencv`.
    """
    cv2 = load_opencv()
    height = int(outline.any(1).sum())
    if not height:
        return np.zeros(outline.shape, np.uint8)
    inside = np.asarray(ndimage.distance_transform_edt(np.pad(outline, 1)))[1:-1, 1:-1] > INNER * height
    near = np.asarray(ndimage.distance_transform_edt(~outline)) <= OUTER * height
    state = np.where(near, cv2.GC_PR_BGD, cv2.GC_BGD)
    state[outline] = cv2.GC_PR_FGD
    state[inside] = cv2.GC_FGD
    state, colours = state.astype(np.uint8), np.ascontiguousarray(pixels[..., ::-1])
    cv2.setRNGSeed(0)
    if inside.any() and not near.all():
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(colours, state, None, *models, ITERATIONS, cv2.GC_INIT_WITH_MASK)
    found = (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
    found = np.asarray(ndimage.binary_opening(found, np.ones((2, 2))), bool) | inside  # edges behind are hair-thin
    parts, _ = cast("tuple[np.ndarray, int]", ndimage.label(found))
    return np.where(found & np.isin(parts, np.unique(parts[inside])), np.uint8(255), np.uint8(0))
