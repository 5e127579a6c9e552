"""Figures are flat, finite and say where they were measured."""

import json
import sys
import time

import demo
import numpy as np
import pytest
import record
import torch
from diffusion_people import write_people
from from_pictures import distance_in_pairs
from neighbours import nearest_stored
from primdiffusion.people.stored_people import find_people, read_person
from support.errors import refused
from tiny_model import tiny_model


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


def test_a_long_stage_shows_how_far_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "PRINT_S", 0.1)
    program = "import time; print('Sample 1/4', flush=True); time.sleep(1.5)"
    assert demo.run_stage("Cycles", [sys.executable, "-c", program], tmp_path / "0.log").took.seconds > 1
    assert " s  Sample 1/4" in capsys.readouterr().out


def test_a_stage_that_fails_shows_the_end_of_its_output(tmp_path):
    with refused(demo.StageFailed, "exit code 3"):
        demo.run_stage("build", [sys.executable, "-c", "print('no room'); raise SystemExit(3)"], tmp_path / "0.log")


def test_nearest_stored_person_of_a_stored_person_is_that_person(tmp_path):
    write_people(tmp_path, 6)
    paths, model = find_people(tmp_path), tiny_model()
    queries = torch.stack([model.encode(read_person(paths[number]).payload(1)).flatten() for number in (4, 2)])
    found = nearest_stored(queries, paths, model.encode)
    assert found.file.tolist() == [4, 2]
    assert found.colouring.tolist() == [1, 1]
    assert float(found.distance.max()) == pytest.approx(0, abs=1e-3)
    without = nearest_stored(queries, [*paths[:2], paths[3], paths[5]], model.encode)
    assert float(without.distance.min()) > 1e-3
    with refused(ValueError, "payload"):
        nearest_stored(queries, [], model.encode)


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
