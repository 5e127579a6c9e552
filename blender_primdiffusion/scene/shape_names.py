"""What is known of shapes without numbers: how many coefficients, how far they go, what their sliders are called."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .shape_model import ShapeModel

BETAS = 10
"""Shape components."""
LARGEST_BETA = 5.0
"""Beyond, bodies of linear shape models fall apart."""
DEFAULT_BODY_VERTICES = 12196
"""Only the body that comes with the extension has as many."""
_CLEAR = {0: "Stature", 1: "Shoulders", 3: "Waist", 5: "Girth"}
"""What single betas of the default body do; the others change several things a little."""


def slider_names(model: ShapeModel) -> list[str]:
    """A name for each beta [10]: by what it does where that is clear, else by its number, from 1."""
    clear = _CLEAR if len(model.template) == DEFAULT_BODY_VERTICES else {}
    return [clear.get(index, f"Shape {index + 1}") for index in range(BETAS)]
