"""Boxes that are sized for skirts."""

import dataclasses

import pytest
import torch
from primdiffusion.body.model import default_body
from primdiffusion.people.wardrobe import OUTFITS, WORDS
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import voxel_centres
from primdiffusion.primitives.skirts import HEMS, LARGEST, MARGIN, box_sizes, voxel_heights


def test_skirts_of_the_wardrobe_are_known():
    outfits = {garment.name: garment for garments in OUTFITS.values() for garment in garments}
    skirts = {name for name, garment in outfits.items() if any(piece.kind == "skirt" for piece in garment.pieces)}
    assert {WORDS["outfit"][name] for name in skirts} == set(HEMS)
    assert box_sizes("suit") is None


@pytest.mark.parametrize("outfit", HEMS)
def test_boxes_between_the_legs_reach_to_the_middle(outfit):
    body, sizes = default_body(), box_sizes(outfit)
    frames = attach(default_anchors(), body.template, body.faces)
    x, y, _ = frames.position.T
    larger = (sizes > 1).any(1)
    assert bool((y[larger] > HEMS[outfit]).all())
    reach = (frames.rotation[:, 0].abs() * frames.half_extent * sizes).amax(1)
    far = sizes.amax(1) < LARGEST
    torch.testing.assert_close(reach[larger & far], MARGIN * x.abs()[larger & far])
    legs = larger.nonzero()[:, 0]
    centres = voxel_centres(dataclasses.replace(frames, half_extent=frames.half_extent * sizes))[legs, ..., 1]
    torch.testing.assert_close(voxel_heights(legs, sizes[legs]), torch.from_numpy(centres).flatten(1))
    mirrored = torch.tensor([-1.0, 1, 1]) * frames.position[legs]
    twin = torch.cdist(mirrored, frames.position[legs]).argmin(1)
    torch.testing.assert_close(sizes[legs].amax(1)[twin], sizes[legs].amax(1), atol=0.02, rtol=0)
