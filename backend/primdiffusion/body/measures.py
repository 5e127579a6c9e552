"""What a body measures, and bodies of given measures."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel, ShapedBody

DENSITY = 985.0
"""kg/m^3 of a living person with air in the lungs."""
MOST_CORRECTIONS = 20
LARGEST_BETA = 5.0
"""Beyond, bodies of linear shape models fall apart."""


class Measures(NamedTuple):
    """Of a bare body."""

    height: float
    """Metres."""
    weight: float
    """Kilograms: the volume within the skin, as heavy as a person."""


def measure(shape: ShapedBody) -> Measures:
    """Height and weight of an unbatched body in its rest pose."""
    vertices = shape.vertices.detach().double()
    height = float(vertices[:, 1].amax() - vertices[:, 1].amin())
    a, b, c = (vertices[shape.model.faces[:, i].long()] for i in range(3))
    volume = float((a * torch.linalg.cross(b, c)).sum()) / 6  # signed tetrahedra to the origin
    return Measures(height, abs(volume) * DENSITY)


def betas_of_measures(
    betas: Float[Tensor, "n"],
    scale: Float[Tensor, "n n"],
    body: BodyModel,
    height: float | None = None,
    weight: float | None = None,
) -> Float[Tensor, "n"]:
    """The betas, moved as little as possible until the body has the given height (m) and weight (kg).

    Distances are those of N(., scale scale^T), the distribution that `betas` are a draw of; so the result is a draw of
    that distribution given the measures, as far as these are linear in betas (Matheron's rule), which Newton steps
    correct. Exact to 0.1 mm and 10 g. Raises ValueError where no body within LARGEST_BETA has these measures.
    """
    wanted = [(number, value) for number, value in enumerate((height, weight)) if value is not None]
    if not wanted:
        return betas
    rows = [number for number, _ in wanted]
    target = torch.tensor([value for _, value in wanted], dtype=torch.float64)
    tolerance = torch.tensor([1e-4, 1e-2], dtype=torch.float64)[rows]
    moved, covariance = betas.double(), (scale @ scale.T).double().cpu()
    for _ in range(MOST_CORRECTIONS):
        missing = target - _measured(moved, body)[rows]
        if (missing.abs() < tolerance).all():
            break
        slope = _slope(moved, body)[rows]
        moved = moved + covariance @ slope.T @ torch.linalg.solve(slope @ covariance @ slope.T, missing)
        if not moved.abs().amax() <= LARGEST_BETA:
            break
    else:
        moved = moved * torch.inf
    if not moved.abs().amax() <= LARGEST_BETA:
        names = (("a height of {:.2f} m", height), ("a weight of {:.0f} kg", weight))
        asked = " with ".join(text.format(value) for text, value in names if value is not None)
        raise ValueError(f"no body of this model has {asked}: ask for something more usual")
    return moved.to(betas)


def _measured(betas: Float[Tensor, "n"], body: BodyModel) -> Float[Tensor, "2"]:
    return torch.tensor(measure(body.shape(betas.to(body.template))), dtype=torch.float64)


def _slope(betas: Float[Tensor, "n"], body: BodyModel, step: float = 0.05) -> Float[Tensor, "2 n"]:
    """Central differences of the measures by each beta."""
    moves = step * torch.eye(len(betas), dtype=torch.float64)
    return torch.stack([(_measured(betas + m, body) - _measured(betas - m, body)) / (2 * step) for m in moves], dim=1)
