"""The same person on another body: boxes follow the surface in place and, in part, in size."""

import dataclasses

import torch
from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.editing.reshaping import SHARE, box_growth, reshape_human
from primdiffusion.human import place
from primdiffusion.primitives.anchors import Anchors, cell_sides, default_anchors
from support.errors import refused

WIDER = torch.tensor([0.3, 2.6, 1.0, 2.2, 0.3, 4.0, 1.5, -1.7, -0.4, -0.3])


def stretched_body(along: torch.Tensor) -> BodyModel:
    """The default body, the first beta of which scales it by `along` + 1 along the three axes."""
    body = default_body()
    basis = torch.zeros_like(body.shape_basis)
    basis[..., 0] = body.template * along
    return dataclasses.replace(body, shape_basis=basis)


def one(value: float) -> torch.Tensor:
    return torch.nn.functional.one_hot(torch.tensor(0), 10) * torch.tensor(value)


def test_with_the_betas_they_have_a_person_is_the_same_object(human):
    assert reshape_human(human, human.betas.clone()) is human
    assert reshape_human(human, human.betas + 5e-6) is human
    assert reshape_human(human, human.betas + 1e-4) is not human


def test_a_body_twice_as_large_has_boxes_larger_by_the_share_and_as_thick():
    growth = box_growth(stretched_body(torch.ones(3)), default_anchors(), one(0.0), one(1.0))
    assert torch.allclose(growth[:, :2], torch.full((1024, 2), 2.0**SHARE), rtol=1e-4)
    assert (growth[:, 2] == 1).all(), "clothes stay as thick"


def test_sides_of_a_cell_are_by_hand_its_length_along_t_and_its_width_across():
    """The corner of a square, stretched to 3 along x and sheared by 0.5: dv leans along T, the cell is no wider."""
    cell = Anchors(
        face=torch.tensor([0]),
        barycentric=torch.full((1, 3), 1 / 3),
        rest_half_extent=torch.ones(1, 3),
        stencil_vertex=torch.tensor([[0, 1, 2]]),
        stencil_du=torch.tensor([[-1.0, 1.0, 0.0]]),
        stencil_dv=torch.tensor([[-1.0, 0.0, 1.0]]),
        chart=torch.tensor([0]),
    )
    corner = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.5, 1.0, 0.0]])
    assert torch.allclose(cell_sides(cell, corner), torch.tensor([[3.0, 1.0]]))


def test_boxes_grow_by_it_and_nothing_else_of_the_payload_changes(human):
    wider = reshape_human(human, WIDER)
    growth = box_growth(default_body(), default_anchors(), human.betas, WIDER)
    assert torch.allclose(wider.betas, WIDER)
    assert torch.allclose(wider.payload.delta_scale, human.payload.delta_scale * growth)
    assert torch.allclose(place(wider).half_extent, place(human).half_extent * growth)
    assert growth[:, :2].max() > 1.2
    assert growth[:, :2].min() < 0.9, "parts of a wider body are narrower"
    assert wider.payload.rgb is human.payload.rgb
    assert wider.payload.density is human.payload.density


def test_reshaping_twice_is_reshaping_once_and_back_again_is_nothing(human):
    other = torch.linspace(-1.5, 1.5, 10)
    twice, once = reshape_human(reshape_human(human, WIDER), other), reshape_human(human, other)
    assert torch.allclose(twice.payload.delta_scale, once.payload.delta_scale, rtol=1e-5)
    back = reshape_human(reshape_human(human, WIDER), human.betas)
    assert torch.allclose(back.payload.delta_scale, human.payload.delta_scale, rtol=1e-5)


def test_another_number_of_betas_and_nan_are_rejected(human):
    with refused(ValueError, "3 betas"):
        reshape_human(human, torch.zeros(3))
    with refused(ValueError, "finite"):
        reshape_human(human, torch.full((10,), torch.nan))
