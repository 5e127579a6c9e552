"""People spread over the workers of a real Ray cluster on this machine."""

import json
import sys
from pathlib import Path

import pytest
from primdiffusion.capture.farm import Farm, render_on, subjects_of
from support.errors import refused

pytest.importorskip("ray", reason="Ray is not installed")
RENDERER = Path(__file__).parents[1] / "farm_renderer.py"


def test_people_whose_worker_or_renderer_is_killed_are_finished_by_another_without_losing_or_doubling_a_view(tmp_path):
    (tmp_path / "anna.2.trouble").write_text("kill worker")
    (tmp_path / "carl.4.trouble").write_text("kill itself")
    (tmp_path / "dora.1.trouble").write_text("fail")
    reports = []
    outcomes = render_on(
        Farm(workers=2), [sys.executable, str(RENDERER), str(tmp_path)], lambda *progress: reports.append(progress)
    )
    assert [(outcome.subject, outcome.exit_code) for outcome in outcomes] == [
        ("anna", 0),
        ("bert", 0),
        ("carl", 0),
        ("dora", 1),
    ]
    assert "no texture" in outcomes[-1].error
    assert [(done, total) for _, done, total in reports] == [(1, 4), (2, 4), (3, 4), (4, 4)]
    rendered = sorted((tmp_path / "log").read_text().splitlines())
    wanted = [f"{name} {view}" for name in ("anna", "bert", "carl") for view in range(6)]
    assert rendered == sorted([*wanted, "dora 0"])


def test_a_renderer_that_is_not_there_is_one_sentence():
    with refused(ValueError, "no-such-blender"):
        subjects_of(["no-such-blender"])


def test_a_renderer_without_people_is_one_sentence():
    with refused(ValueError, "the folder is empty"):
        subjects_of([sys.executable, "-c", "import sys; sys.exit('the folder is empty')"])


@pytest.mark.parametrize("name", ["--python=evil.py", "-x", "../anna", "", "anna bert", 7])
def test_a_subject_that_would_be_an_option_or_a_path_is_handed_to_no_renderer(name):
    listed = f"print({'PRIMDIFFUSION ' + json.dumps({'line': name})!r})"
    with refused(ValueError, repr(name)):
        subjects_of([sys.executable, "-c", listed])
