"""Figures are flat, finite and say where they were measured."""

import json

import faults
import numpy as np
import pytest
import record
import torch
from from_pictures import distance_in_pairs
from support.errors import refused


def test_a_record_holds_the_figures_and_where_they_come_from(tmp_path):
    path = tmp_path / "docs" / "figures.json"
    record.write_record(path, {"seconds_generate": 1.5, "people_iou_mean": None})
    written = json.loads(path.read_text())
    assert written["seconds_generate"] == 1.5
    assert written["people_iou_mean"] is None
    assert written["device"]
    assert written["commit"]
    assert written["version_torch"].startswith("2.")
    assert all(not isinstance(value, dict | list) for value in written.values())
    assert [p.name for p in path.parent.iterdir()] == ["figures.json"]


@pytest.mark.parametrize("figures", [{"seconds": float("nan")}, {"seconds": float("inf")}, {"device": 3}])
def test_a_figure_that_is_none_is_rejected_by_name(tmp_path, figures):
    with refused(ValueError, next(iter(figures))):
        record.write_record(tmp_path / "f.json", figures)
    assert list(tmp_path.iterdir()) == []


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


def test_every_attack_of_the_benchmark_is_a_test_that_is_there():
    for path, _, name in (attack.partition("::") for attack in faults.ATTACKS):
        text = (faults.ROOT / path).read_text(encoding="utf-8")
        assert f"def {name or 'test_'}" in text
