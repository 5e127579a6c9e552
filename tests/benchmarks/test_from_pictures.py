"""The distance of reconstructions from their own subjects."""

import numpy as np
import pytest
import torch
from from_pictures import distance_in_pairs


def test_distance_in_pairs_is_that_of_every_two_pairs():
    first, second = torch.randn(2, 7, 5, generator=torch.Generator().manual_seed(0)).unbind()

    def kernel(a: torch.Tensor, b: torch.Tensor) -> float:
        return (float(a @ b) / 5 + 1) ** 3

    each = [
        kernel(x, other_x) + kernel(y, other_y) - kernel(x, other_y) - kernel(other_x, y)
        for i, (x, y) in enumerate(zip(first, second, strict=True))
        for j, (other_x, other_y) in enumerate(zip(first, second, strict=True))
        if i != j
    ]
    assert distance_in_pairs(first, second) == pytest.approx(np.mean(each), rel=1e-5)


def test_pairs_of_one_distribution_have_no_distance_and_others_do():
    generator = torch.Generator().manual_seed(1)
    person = torch.randn(400, 5, generator=generator)
    noise = torch.randn(2, 400, 5, generator=generator)
    near = distance_in_pairs(person + 0.3 * noise[0], person + 0.3 * noise[1])
    assert abs(near) < 0.05 < 0.5 < distance_in_pairs(person + 0.3 * noise[0], person + 0.7)
