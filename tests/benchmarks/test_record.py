"""Figures are flat, finite and say where they were measured."""

import json
import time

import numpy as np
import pytest
import record
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


def test_a_block_is_measured_in_seconds_and_in_memory_it_gave_back():
    with record.measured() as took:
        time.sleep(0.1)
        block = np.ones(50_000_000)
        time.sleep(0.1)
        del block
    with record.measured() as after:
        pass
    assert took.seconds >= 0.2
    assert took.peak_gb > after.peak_gb + 0.3
