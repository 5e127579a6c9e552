"""Masks of photographs by the human that is fitted to them: cut out by its outline, without what is not the person.

GrabCut (Rother, Kolmogorov, Blake 2004) is OpenCV's, from the optional extra `primdiffusion[cutout]`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage
from torch import Tensor

from primdiffusion.capture.photograph import Photograph
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.reconstruction.posture_fit import COARSE, Posture
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import march

INNER, OUTER = 0.018, 0.045
"""Widths of the bands within and around the outline in which it is sought, as shares of its height."""
THIN = 0.8
"""Share of the depth nearby from which a part that is thinner than the inner band, such as a hand, is inside."""
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
    depth = np.asarray(ndimage.distance_transform_edt(np.pad(outline, 1)))[1:-1, 1:-1]
    deepest = ndimage.maximum_filter(depth, 2 * int(INNER * height) + 1)
    inside = outline & (depth > np.minimum(INNER * height, THIN * deepest))
    near = np.asarray(ndimage.distance_transform_edt(~outline)) <= OUTER * height
    state = np.where(near, cv2.GC_PR_BGD, cv2.GC_BGD)
    state[inside] = cv2.GC_FGD  # the band teaches its colours to the background: a body's outline covers some of it
    state, colours = state.astype(np.uint8), np.ascontiguousarray(pixels[..., ::-1])
    cv2.setRNGSeed(0)
    if inside.any() and not near.all():
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(colours, state, None, *models, ITERATIONS, cv2.GC_INIT_WITH_MASK)
    found = (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
    found = np.asarray(ndimage.binary_opening(found, np.ones((2, 2))), bool) | inside  # edges behind are hair-thin
    parts, _ = cast("tuple[np.ndarray, int]", ndimage.label(found))
    return np.where(found & np.isin(parts, np.unique(parts[inside])), np.uint8(255), np.uint8(0))


CLOTHES = 0.03
"""Width around the human, as a share of its height, in which a mask may be larger: hair, wide sleeves and hems."""
LEAST_PART = 0.012
"""Share of the mask from which a part that no body explains is left out."""


def grown(mask: Bool[Tensor, "H W"], reach: float) -> Bool[Tensor, "H W"]:
    """All pixels within `reach` of a mask."""
    return torch.from_numpy(np.asarray(ndimage.distance_transform_edt(~mask.numpy())) <= reach) if mask.any() else mask


def unexplained(drawn: Float[Tensor, "H W"], opacity: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Parts of a mask, each of some size, that lie farther from the human drawn than wide clothes do."""
    mask = opacity > 0.5
    beyond = mask & ~grown(drawn > 0.5, CLOTHES * int(mask.any(1).sum()))
    opened = ndimage.binary_opening(beyond.numpy(), np.ones((2, 2)))
    labels, count = cast("tuple[np.ndarray, int]", ndimage.label(opened))
    large = [number for number in range(1, count + 1) if (labels == number).sum() > LEAST_PART * int(mask.sum())]
    return torch.from_numpy(np.isin(labels, large))


@torch.no_grad()
def without_things(payload: Payload, photograph: Photograph, target: PosedView) -> Photograph:
    """The photograph without the parts of its mask that the human does not explain; itself if there are none."""
    drawn = march(Primitives.place(target.frames, payload), target.camera, COARSE).alpha
    parts = unexplained(drawn, target.rgba[..., 3])
    if not parts.any():
        return photograph
    gone = (grown(parts, CLOTHES * int((target.rgba[..., 3] > 0.5).any(1).sum())) & (drawn < 0.5)).numpy()
    side = len(photograph.rgba)
    block = side // len(gone)  # pixels of the target are means over blocks
    large = np.kron(gone, np.ones((block, block), bool))
    large = np.pad(large, [(0, max(0, side - len(large)))] * 2, mode="edge")[:side, :side]
    return dataclasses.replace(photograph, rgba=photograph.rgba * ~large[..., None])


@torch.no_grad()
def cut_by_outline(payload: Payload, photograph: Photograph, target: PosedView) -> Photograph:
    """The person of an uncut photograph, cut out by the outline of the human in the small picture of the target.

    Where the human is not in the picture, the photograph stays as it is.
    """
    assert photograph.uncut is not None
    drawn = march(Primitives.place(target.frames, payload), target.camera, COARSE).alpha.numpy()
    side = len(photograph.rgba)
    block = side // len(drawn)
    size = len(drawn) * block
    large = np.asarray(Image.fromarray(drawn).resize((size, size), Image.Resampling.BILINEAR))
    outline = np.pad(large, [(0, side - size)] * 2, mode="edge") > 0.5
    mask = cut_out(photograph.uncut[..., :3], outline)
    return photograph.with_mask(mask) if mask.any() else photograph


@torch.no_grad()
def outline_in(payload: Payload, posture: Posture, size: tuple[int, int]) -> UInt8[np.ndarray, "H W"]:
    """255 where the human can be in a picture of this width and height, by the posture's small camera."""
    (frames,), camera = posture.frames(), posture.camera.map(lambda values: values[0])
    drawn = march(Primitives.place(frames, payload), camera, COARSE).alpha > 0.5
    near = grown(drawn, OUTER * int(drawn.any(1).sum())).numpy()
    return np.asarray(Image.fromarray(near).convert("L").resize(size, Image.Resampling.NEAREST))
