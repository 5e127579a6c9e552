"""Parts of faults.json are measured one by one, each with its own commit, and kept by the next."""

import json
import sys

import faults
import pytest

NAMES = {
    "threads_person_error_max", "same_bytes_threads",
    "blend_properties_tried", "files_written_outside", "window_rounds", "window_crashes", "attack_cases",
    "attack_cases_held",
}  # fmt: skip


@pytest.fixture
def measure(monkeypatch, tmp_path):
    """Run the program with parts that give a number, except one that may fail; returns what is in its file."""

    def measure(number, *words, failing=""):
        def part(name):
            def found(_):
                if name == failing:
                    raise SystemExit(f"{name} failed")
                return dict.fromkeys(faults.PARTS[name].figures, number)

            return faults.Part(faults.PARTS[name].figures, found)

        parts = {name: part(name) if name != "window" else faults.PARTS[name] for name in faults.PARTS}
        with monkeypatch.context() as patch:
            patch.setattr(faults, "PARTS", parts)
            patch.setattr(faults, "stamp", lambda: f"stamp {number}")
            patch.setattr(sys, "argv", ["faults.py", "--json", str(tmp_path / "faults.json"), *words])
            if failing:
                with pytest.raises(SystemExit, match=failing):
                    faults.main()
            else:
                faults.main()
        return json.loads((tmp_path / "faults.json").read_text())

    return measure


@pytest.fixture
def window(tmp_path):
    (tmp_path / "figures.json").write_text(json.dumps({"window_rounds": 100, "window_crashes": 0, "other": 1}))
    return tmp_path / "figures.json"


def test_every_figure_that_is_read_is_measured(measure, window):
    found = measure(1, "--window", str(window))
    assert set(found) >= NAMES
    assert (found["window_rounds"], found["window_crashes"]) == (100, 0)
    assert "other" not in found


def test_without_a_window_its_figures_are_absent_or_kept(measure, window):
    assert "window_rounds" not in measure(1)
    measure(1, "--window", str(window), "--parts", "window")
    assert measure(2)["window_rounds"] == 100


def test_a_part_is_measured_anew_alone_and_says_when(measure, tmp_path):
    (tmp_path / "faults.json").write_text(json.dumps({"earlier_seconds": 3.0, "window_crashes": 20, "commit": "old"}))
    assert measure(1, "--parts", "attacks")["window_crashes"] == 20
    found = measure(2, "--parts", "threads", "blends")
    assert (found["attack_cases"], found["attacks_recorded"]) == (1, "stamp 1")
    assert (found["blend_properties_tried"], found["blends_recorded"]) == (2, "stamp 2")
    assert "earlier_seconds" not in found  # nothing measures it any more
    assert found["commit"] != "old"


def test_a_part_that_fails_leaves_those_before_it(measure):
    found = measure(1, failing="attacks")
    assert found["blend_properties_tried"] == 1
    assert "attack_cases" not in found


def test_a_window_that_is_not_given_is_named(measure, capsys):
    with pytest.raises(SystemExit):
        measure(1, "--parts", "window")
    assert "--window" in capsys.readouterr().err


def test_every_attack_is_a_test_that_is_there():
    for path, _, name in (attack.partition("::") for attack in faults.ATTACKS):
        text = (faults.ROOT / path).read_text(encoding="utf-8")
        assert f"def {name or 'test_'}" in text
