"""Conditioning: attributes of a person encoded as numbers for the denoiser.

Classifier-free (Ho and Salimans 2022): a missing attribute is a block of zeros, so one network models people given
all, some or no attributes, and the paper's unconditional model is the one with no attributes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.files.arrays import LARGEST_NUMBER

Attributes = Mapping[str, str | float]
"""Requested attributes of a person: {"sex": "female", "height": 1.7}."""
FARTHEST = 4.0
"""Largest distance from the mean of a requested number, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class AttributeVocabulary:
    """Attributes and their values in the data that a model was trained on."""

    categories: Mapping[str, tuple[str, ...]]
    """Name -> values to choose from."""
    scalars: Mapping[str, tuple[float, float]]
    """Name -> mean and standard deviation."""

    @property
    def width(self) -> int:
        """Numbers in a condition: one for each value of a category, two for each scalar."""
        return sum(map(len, self.categories.values())) + 2 * len(self.scalars)

    def encode(self, attributes: Attributes) -> Float[Tensor, "a"]:
        """One-hot blocks, then (known, standardised) pairs; missing attributes are all 0.

        Raises ValueError for an unknown name or value; the message lists the known ones.
        """
        self._check_names(attributes)
        numbers: list[float] = []
        for name, values in self.categories.items():
            wanted = attributes.get(name)
            if wanted is not None and wanted not in values:
                raise ValueError(f"there is no {name} {wanted!r}: choose one of {', '.join(values)}")
            numbers += [float(value == wanted) for value in values]
        for name in self.scalars:
            numbers += self._scalar(name, attributes.get(name))
        return torch.tensor(numbers)

    def complete(self, asked: Float[Tensor, "#b a"], drawn: Float[Tensor, "b a"]) -> Float[Tensor, "b a"]:
        """Return the conditions `asked` with the values of `drawn` for categories that they leave open."""
        condition = asked.expand_as(drawn).clone()
        for block in self.blocks().values():
            is_open = (condition[:, block] == 0).all(1, keepdim=True)
            condition[:, block] = torch.where(is_open, drawn[:, block], condition[:, block])
        return condition

    def blocks(self) -> dict[str, slice]:
        """Slice of each category's numbers in a condition."""
        places, start = {}, 0
        for name, values in self.categories.items():
            places[name] = slice(start, start + len(values))
            start += len(values)
        return places

    def forget(self, condition: Float[Tensor, "b a"], share: float, generator: torch.Generator) -> Float[Tensor, "b a"]:
        """Drop attributes at random, for training.

        A sample loses all attributes with probability `share`; otherwise each attribute with a probability drawn for
        that sample, so that subsets of all sizes occur.
        """
        count = len(self.categories) + len(self.scalars)
        if not count:
            return condition
        draws = torch.rand(len(condition), count + 2, generator=generator, device=generator.device)
        kept = (draws[:, 2:] > draws[:, :1]) & (draws[:, 1:2] >= share)
        sizes = torch.tensor([*map(len, self.categories.values()), *[2] * len(self.scalars)], device=kept.device)
        return condition * kept.to(condition).repeat_interleave(sizes, dim=1)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for a checkpoint's metadata."""
        return {
            "categories": {name: list(values) for name, values in self.categories.items()},
            "scalars": {name: list(values) for name, values in self.scalars.items()},
        }

    @classmethod
    def from_json(cls, tree: Mapping[str, Any]) -> AttributeVocabulary:
        """Inverse of `to_json`; raises KeyError, TypeError, AttributeError or ValueError for other input."""
        categories = {name: tuple(map(str, values)) for name, values in tree["categories"].items()}
        scalars = {name: (float(mean), float(std)) for name, (mean, std) in tree["scalars"].items()}
        if not all(abs(mean) <= LARGEST_NUMBER and 0 < std <= LARGEST_NUMBER for mean, std in scalars.values()):
            raise ValueError("a mean or standard deviation is one that no quantity has")
        return cls(categories, scalars)

    def _check_names(self, attributes: Attributes) -> None:
        known = [*self.categories, *self.scalars]
        for name in attributes:
            if name not in known:
                choices = ", ".join(known) or "nothing: it was trained without attributes"
                raise ValueError(f"this model knows no attribute {name!r}; it knows {choices}")

    def _scalar(self, name: str, value: str | float | None) -> list[float]:
        if value is None:
            return [0.0, 0.0]
        mean, std = self.scalars[name]
        low, high = mean - FARTHEST * std, mean + FARTHEST * std
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not low <= number <= high:
            raise ValueError(f"{name} is {value!r}: give a number from {low:.4g} to {high:.4g}")
        return [1.0, (number - mean) / std]


NOTHING = AttributeVocabulary({}, {})
"""Vocabulary of an unconditional model."""
