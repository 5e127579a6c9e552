"""Errors of the child: advice on settings that cost memory."""

from __future__ import annotations

import pytest

from blender_primdiffusion.backend.requests import memory_advice

pytestmark = pytest.mark.any_blender


@pytest.mark.parametrize(
    ("params", "advice"),
    [
        ({"views": 8}, "lower Views, or close other programs"),
        ({"seeds": [1, 2], "steps": 3}, "lower Count, or close other programs (fewer Steps would not help)"),
        ({"steps": 3}, "choose a smaller Checkpoint in the preferences (fewer Steps would not help)"),
        ({"voxel": 0.01}, "raise Voxel Size, or close other programs"),
    ],
)
def test_memory_advice_names_settings_that_cost_memory(params, advice):
    assert memory_advice(params) == advice
