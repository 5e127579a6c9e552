"""Metrics go to a tracker as they go to metrics.jsonl."""

import sys
import types

import pytest
from accelerate import PartialState
from diffuse_runs import make_small, settings
from primdiffusion.runtime.failures import MissingPackageError
from primdiffusion.training.config import check_resumable, to_json
from primdiffusion.training.diffuse import train
from primdiffusion.training.run_folder import open_metrics
from support.errors import refused
from support.runs import rows


class Wandb(types.ModuleType):
    """As much of wandb as accelerate's tracker calls."""

    def __init__(self):
        super().__init__("wandb")
        self.lines, self.finished = [], False

    def init(self, **settings):
        self.settings = settings
        return self

    def log(self, values, step=None):
        self.lines.append((step, values))

    def finish(self):
        self.finished = True


def test_tensorboard_gets_every_number_of_every_phase(people, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    make_small(monkeypatch)
    config = settings(people, tmp_path / "run", tracker="tensorboard")
    train(config)
    events = EventAccumulator(str(config.run / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    offset = {"person": 0, "local": config.person.steps}
    for row in rows(config.run):
        phase = row.pop("phase")
        for name, value in row.items():
            sent = {event.step: event.value for event in events.Scalars(f"{phase}/{name}")}
            assert sent[offset[phase] + row["step"]] == pytest.approx(value, rel=1e-5)


def test_wandb_is_started_in_the_run_folder_and_steps_never_fall(people, tmp_path, monkeypatch):
    make_small(monkeypatch)
    wandb = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    config = settings(people, tmp_path / "run", tracker="wandb")
    train(config)
    assert wandb.settings == {"project": "primdiffusion", "name": "run", "dir": str(config.run)}
    assert wandb.finished
    steps = [step for step, _ in wandb.lines]
    assert steps == sorted(steps)
    assert len(wandb.lines) == len(rows(config.run))
    assert any("local/loss" in values for _, values in wandb.lines)


def test_lines_without_a_phase_are_sent_too(tmp_path, monkeypatch):
    PartialState()  # as a run has, and as tests before this one may have: trackers log through it
    wandb = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    with open_metrics(settings(tmp_path, tmp_path, tracker="wandb")) as metrics:
        metrics.append({"step": 3, "loss": 0.5}, 3)
    assert wandb.lines == [(3, {"step": 3, "loss": 0.5})]


def test_without_the_package_one_sentence_and_no_folder(people, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    config = settings(people, tmp_path / "run", tracker="wandb")
    with refused(MissingPackageError, '"primdiffusion[tracking]"'):
        train(config)
    assert not config.run.exists()


def test_a_run_may_go_on_with_another_tracker(tmp_path):
    before = settings(tmp_path, tmp_path / "run")
    check_resumable(to_json(before), settings(tmp_path, tmp_path / "run", tracker="wandb"))
