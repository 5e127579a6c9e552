"""Masks of photographs by the human that is fitted to them: cut out by its outline, without what is no person's."""

from __future__ import annotations

import dataclasses
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage
from torch import Tensor

from primdiffusion.capture.cut_out import OUTER, cut_out
from primdiffusion.capture.photograph import Photograph
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.reconstruction.posture_fit import COARSE, Posture
from primdiffusion.render.image import PosedView
from primdiffusion.render.march import march

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
