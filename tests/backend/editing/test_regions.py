"""Parts of the body where an artist expects them, and paint as it was painted."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from primdiffusion.body.model import default_body
from primdiffusion.editing.regions import (
    DISJOINT,
    PARTS,
    check_region,
    name_region,
    parts_of,
    read_weights,
    region_from_weights,
    region_of,
)
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.primitives.anchors import attach, build_anchors, default_anchors
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import GRID, K
from support.errors import refused


@pytest.fixture(scope="module")
def rest() -> torch.Tensor:
    body = default_body()
    return attach(default_anchors(), body.template, body.faces).position


@pytest.fixture(scope="module")
def joints() -> dict[str, torch.Tensor]:
    return dict(zip(JOINT_NAMES, default_body().shape(torch.zeros(10)).joints, strict=True))


def test_disjoint_parts_share_no_primitive_and_are_the_whole_person():
    masks = torch.stack([region_of([name]) for name in DISJOINT])
    assert (masks.sum(0) == 1).all()


def test_every_part_has_primitives_and_none_is_everything():
    for name in PARTS:
        assert 0 < region_of([name]).sum() < K, name


@pytest.mark.parametrize(
    ("union", "members"),
    [
        ("head", ["face", "hair", "neck"]),
        ("top", ["torso", "neck", "arms"]),
        ("bottom", ["hips", "legs"]),
        ("shoes", ["feet"]),
        ("clothes", ["top", "bottom", "shoes"]),
        ("skin", ["face", "neck", "hands"]),
        ("hands", ["left_hand", "right_hand"]),
    ],
)
def test_unions_are_what_their_names_say(union, members):
    assert torch.equal(region_of([union]), region_of(members))


def test_parts_are_as_symmetric_as_the_layout():
    grids = {name: mask.reshape(GRID, GRID) for name, mask in parts_of().items()}
    for name, grid in grids.items():
        other = name.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
        assert torch.equal(grid, grids[other].flip(1)), name


def test_left_is_the_persons_left(rest):
    assert (rest[region_of(["left_hand"]), 0] > 0.5).all()
    assert (rest[region_of(["right_foot"]), 0] < 0).all()


def test_parts_lie_where_their_joints_are(rest, joints):
    def middle(name):
        return rest[region_of([name])].mean(0)

    assert middle("face")[2] > joints["head"][2] + 0.03 > middle("hair")[2] + 0.03
    assert middle("hair")[1] > middle("face")[1] > middle("neck")[1] > middle("torso")[1] > middle("hips")[1]
    assert middle("hips")[1] > middle("thighs")[1] > middle("shins")[1] > middle("feet")[1]
    for upper, lower in (("thighs", "knee"), ("shins", "ankle")):
        assert rest[region_of([upper]), 1].min() > joints[f"left_{lower}"][1] - 0.06
    assert rest[region_of(["left_upper_arm"]), 0].max() < joints["left_elbow"][0] + 0.05
    assert rest[region_of(["left_forearm"]), 0].max() < joints["left_wrist"][0] + 0.02, "where sleeves end"
    assert rest[region_of(["left_hand"]), 0].min() > joints["left_wrist"][0] + 0.02


def test_hair_covers_the_crown_and_the_back_of_the_head_but_no_cheek(rest, joints):
    hair, face = region_of(["hair"]), region_of(["face"])
    crown = rest[:, 1] > joints["head"][1] + 0.135
    back = (rest[:, 1] > joints["head"][1] + 0.02) & (rest[:, 2] < joints["head"][2] - 0.04) & (rest[:, 0].abs() < 0.1)
    assert hair[crown].all()
    assert hair[back].all()
    nose = rest[:, 2] > joints["head"][2] + 0.1
    assert face[nose & (rest[:, 1] > joints["head"][1])].sum() >= 4


def test_an_unknown_part_is_rejected_with_the_choices():
    with refused(ValueError, "hat"):
        region_of(["top", "hat"])
    with refused(ValueError, "face"):
        region_of([])


def painted_over(region: torch.Tensor) -> torch.Tensor:
    """Weight 1 on the vertices of the faces under a region's texels."""
    from primdiffusion.primitives.anchors import default_texels

    face, _ = default_texels()
    cells = face.reshape(GRID, 8, GRID, 8).transpose(1, 2).reshape(K, 64)
    weights = torch.zeros(len(default_body().template))
    weights[default_body().faces[cells[region].flatten()].flatten()] = 1
    return weights


def test_paint_over_a_part_selects_it_and_little_around_it():
    top = region_of(["top"])
    region = region_from_weights(painted_over(top))
    assert region[top].all()
    assert (region & ~top).sum() < 0.2 * top.sum()


def test_boxes_of_which_half_the_patch_is_painted_are_the_region(rest):
    whole = torch.ones(len(default_body().template))
    assert region_from_weights(whole).all()
    assert region_from_weights(0.5 * whole).all()
    left = (default_body().template[:, 0] > 0).float()
    assert (rest[region_from_weights(left), 0] > -0.01).all()


@pytest.mark.parametrize(
    ("weights", "fact"),
    [
        (torch.ones(100), "12196 vertices"),
        (torch.ones(12196, 1), "(12196, 1)"),
        (torch.zeros(12196), "covers no primitive"),
        (torch.full((12196,), 0.4), "0.40"),
        (torch.full((12196,), float("nan")), "NaN"),
    ],
)
def test_unusable_paint_is_rejected(weights, fact):
    with refused(ValueError, fact):
        region_from_weights(weights)


@pytest.mark.parametrize(
    ("region", "fact"),
    [
        (torch.zeros(K, dtype=torch.bool), "empty"),
        (torch.ones(K - 1, dtype=torch.bool), "bool (1023,)"),
        (torch.ones(K), "float32 (1024,)"),
    ],
)
def test_an_invalid_mask_is_rejected(region, fact):
    with refused(ValueError, fact):
        check_region(region)


@given(st.sets(st.sampled_from(DISJOINT), min_size=1), st.sets(st.integers(0, K - 1)))
def test_a_region_is_serialised_by_its_parts_or_bit_by_bit(parts, painted):
    region = region_of(sorted(parts))
    region[sorted(painted)] ^= True
    name = name_region(region)
    if isinstance(name, str):
        assert [bit == "1" for bit in f"{int(name, 16):01024b}"] == region.tolist()
    else:
        assert torch.equal(region_of(name), region)
    assert isinstance(name, list) or painted


@given(st.lists(st.sampled_from(PARTS), min_size=1, max_size=4))
def test_a_region_of_several_parts_is_all_of_each(parts):
    assert torch.equal(region_of(parts), torch.stack([region_of([part]) for part in parts]).any(0))


def test_another_bodys_people_have_parts_too():
    body = default_body()
    body_setup = BodySetup(body, build_anchors(body, "released"), None)
    parts = parts_of(body_setup)
    assert torch.stack([parts[name] for name in DISJOINT]).sum(0).eq(1).all()
    whole = torch.ones(len(body.template))
    assert region_from_weights(whole, body_setup=body_setup).all()


@pytest.mark.parametrize("weights", [np.array([np.nan]), np.full(3, 1e39), np.array("text"), np.zeros((2, 2))])
def test_painted_weights_are_finite_numbers(tmp_path, weights):
    np.savez(tmp_path / "weights.npz", weights=weights)
    with refused(ValueError, "weights.npz"):
        read_weights(tmp_path / "weights.npz")
