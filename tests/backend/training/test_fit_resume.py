"""A run of stage 1 that was stopped or ran out of disk goes on as if it had not; test_diffuse kills the same loop."""

import errno
import json
import logging
import os
import shutil
import signal
from pathlib import Path

import pytest
import torch
from fit_scenes import STATE, WHOLE, files, logged, make_small, settings, stop_after
from primdiffusion.encoder.model import load_encoder
from primdiffusion.training import loop
from primdiffusion.training.fit import MODEL, fit
from primdiffusion.training.fit_config import LossConfig
from primdiffusion.training.loop import Interrupt
from primdiffusion.training.run_folder import CONFIG, METRICS, RUN
from primdiffusion.training.state import TrainingState
from safetensors import safe_open
from support.errors import refused
from support.runs import same_tensors, sentence, timeless

pytestmark = pytest.mark.usefixtures("small_fit")


@pytest.fixture(scope="module")
def whole(captures, tmp_path_factory):
    """A run of six steps that nothing disturbed; its four samples come round again."""
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        config = settings(captures, tmp_path_factory.mktemp("whole") / "run")
        fit(config)
        return config.run


@pytest.fixture(scope="module")
def one_step(captures, tmp_path_factory):
    """A run of one step."""
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        config = settings(captures, tmp_path_factory.mktemp("one_step") / "run")
        with stop_after(1):
            fit(config)
        return config.run


@pytest.fixture
def begun(captures, one_step, tmp_path):
    """The settings of a run that took one step."""
    shutil.copytree(one_step, tmp_path / "run")
    return settings(captures, tmp_path / "run")


def place(run: Path) -> dict[str, str]:
    with safe_open(run / STATE, framework="pt") as file:
        return {name: value for name, value in file.metadata().items() if name in ("step", "position")}


def contents(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in (STATE, MODEL, CONFIG)}


def test_a_run_in_parts_is_bit_identical_to_one_in_one_go(captures, whole, tmp_path):
    run = tmp_path / "run"
    for workers in (1, 0):
        with stop_after(1):
            fit(settings(captures, run, workers=workers))
        torch.randn(3)  # whatever else is drawn in between does not matter
    assert place(run) == {"step": "2", "position": "[0, 2]"}
    fit(settings(captures, run))
    assert place(run) == place(whole) == {"step": "6", "position": "[1, 2]"}
    assert same_tensors(run / STATE, whole / STATE)
    assert same_tensors(run / MODEL, whole / MODEL)
    assert timeless(run) == timeless(whole)
    starts = json.loads((run / RUN).read_text())["starts"]
    assert [start["step"] for start in starts] == [0, 1, 2]


def test_a_kill_before_the_first_save_begins_again(captures, whole, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / CONFIG).write_bytes((whole / CONFIG).read_bytes())
    (run / RUN).write_bytes((whole / RUN).read_bytes())
    (run / METRICS).write_bytes((whole / METRICS).read_bytes())
    with stop_after(1):
        fit(settings(captures, run))
    assert logged(run) == [1]


def test_a_finished_run_is_left_as_it_is_and_one_given_more_steps_goes_on(captures, begun):
    fit(settings(captures, begun.run, steps=2))
    before = contents(begun.run)
    assert fit(settings(captures, begun.run, steps=2)).card["steps"] == 2
    assert contents(begun.run) == before
    assert fit(settings(captures, begun.run, steps=3)).card["steps"] == 3
    assert logged(begun.run) == [1, 2, 3]


def test_a_full_disk_leaves_the_last_checkpoint_whole_and_nothing_beside_it(captures, begun, monkeypatch):
    before, write = contents(begun.run), Path.write_bytes

    def full(path, content):
        if path.name.startswith(f".{Path(STATE).stem}."):
            write(path, content[:1000])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError) as error:
        fit(settings(captures, begun.run, steps=3))
    assert sentence(error.value) == (
        f"{begun.run / STATE}: no space left on device: check the disk's free space and the path, then try again"
    )
    assert (begun.run / STATE).read_bytes() == before[STATE]
    assert load_encoder(begun.run / MODEL).card["steps"] in (1, 3)
    assert files(begun.run) >= WHOLE - {"pictures"}
    assert [path.name for path in begun.run.glob(".*")] == [".lock"]
    monkeypatch.undo()
    make_small(monkeypatch)
    fit(settings(captures, begun.run, steps=3))
    assert logged(begun.run) == [1, 2, 3]


@pytest.mark.parametrize("part", ["network", "average"])
def test_weights_that_are_not_finite_replace_nothing(captures, begun, monkeypatch, part):
    before, update = contents(begun.run), TrainingState.update

    def diverge(self, loss):
        norm = update(self, loss)
        next(getattr(self, part).parameters()).data[:] = float("nan")
        return norm

    monkeypatch.setattr(TrainingState, "update", diverge)
    with refused(ValueError, "stem.0.bias"), stop_after(1):
        fit(begun)
    assert (begun.run / STATE).read_bytes() == before[STATE]
    assert torch.isfinite(load_encoder(begun.run / MODEL).encoder.stem[0].bias).all()


def test_other_settings_in_the_same_folder_are_named_but_limits_processes_and_places_may_change(
    captures, begun, tmp_path, caplog
):
    before = contents(begun.run)
    with refused(ValueError, "learning_rate", "0.0001", "0.02", "loss.silhouette", "2.0") as error:
        fit(settings(captures, begun.run, learning_rate=0.02, loss=LossConfig(silhouette=1.0)))
    assert str(begun.run) in sentence(error.value)
    assert contents(begun.run) == before
    about = json.loads((begun.run / RUN).read_text())
    about["starts"][0]["processes"] = 4
    (begun.run / RUN).write_text(json.dumps(about))
    (tmp_path / "link").symlink_to(captures)
    moved = begun.run.rename(tmp_path / "moved")
    with caplog.at_level(logging.INFO):
        fit(settings(tmp_path / "link", moved, steps=2, save_every=1.0, log_every=2, workers=1))
    assert logged(moved) == [1, 2]
    assert "training on 1 process\n" in caplog.text
    assert "resuming on 1 processes instead of 4" in caplog.text


def test_a_polite_kill_asks_to_stop_and_a_second_ctrl_c_stops_at_once(monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    with Interrupt(None) as interrupt:
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt.due()
        os.kill(os.getpid(), signal.SIGINT)  # within the two seconds in which launchers pass the same one on
        monkeypatch.setattr(loop, "FORCE_QUIT_AFTER_S", 0.0)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before
