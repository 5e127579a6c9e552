"""Measure bodies, and find bodies with given measures."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel, ShapedBody

DENSITY = 985.0
"""kg/m^3 of a living human with air in the lungs."""
MOST_CORRECTIONS = 20
LARGEST_BETA = 5.0
"""Linear shape models produce broken bodies beyond this value."""


class Measures(NamedTuple):
    """Measures of a body without clothes."""

    height: float
    """Metres."""
    weight: float
    """Kilograms, from the volume and DENSITY."""


def measure(shape: ShapedBody) -> Measures:
    """Height and weight of an unbatched body in its rest pose."""
    vertices = shape.vertices.detach().double()
    height = float(vertices[:, 1].amax() - vertices[:, 1].amin())
    a, b, c = (vertices[shape.model.faces[:, i].long()] for i in range(3))
    volume = float((a * torch.linalg.cross(b, c)).sum()) / 6  # sum of signed tetrahedra to the origin
    return Measures(height, abs(volume) * DENSITY)


def betas_of_measures(
    betas: Float[Tensor, "n"],
    scale: Float[Tensor, "n n"],
    body: BodyModel,
    height: float | None = None,
    weight: float | None = None,
) -> Float[Tensor, "n"]:
    """Change betas as little as possible so that the body has the given height (m) and weight (kg).

    Distance is the Mahalanobis distance of N(., scale scale^T), the distribution that `betas` were sampled from. As far
    as measures are linear in betas, the result is a sample of that distribution conditioned on the measures (Matheron's
    rule); Newton steps correct the rest. Accurate to 0.1 mm and 10 g. Raises ValueError if no body within LARGEST_BETA
    has these measures.
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
        raise ValueError(f"no body of this model has {asked}: choose less extreme values")
    return moved.to(betas)


def _measured(betas: Float[Tensor, "n"], body: BodyModel) -> Float[Tensor, "2"]:
    return torch.tensor(measure(body.shape(betas.to(body.template))), dtype=torch.float64)


def _slope(betas: Float[Tensor, "n"], body: BodyModel, step: float = 0.05) -> Float[Tensor, "2 n"]:
    """Central differences of the measures with respect to each beta."""
    moves = step * torch.eye(len(betas), dtype=torch.float64)
    return torch.stack([(_measured(betas + m, body) - _measured(betas - m, body)) / (2 * step) for m in moves], dim=1)
