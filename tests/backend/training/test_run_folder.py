"""The folder of a run."""

import sys
import types

import diffuse_runs
import fit_scenes
import pytest
import tyro
from accelerate import PartialState
from diffuse_runs import settings
from primdiffusion.files.regular_files import FileError
from primdiffusion.runtime.failures import MissingPackageError
from primdiffusion.runtime.worker_process import lock_folder
from primdiffusion.training.config import TrainingConfig, check_resumable, to_json
from primdiffusion.training.diffuse import train
from primdiffusion.training.fit import fit
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.run_folder import open_metrics
from support.errors import refused
from support.runs import rows


@pytest.mark.parametrize(
    "start",
    [
        lambda data, run: train(diffuse_runs.settings(data, run)),
        lambda data, run: fit(fit_scenes.settings(data, run)),
    ],
    ids=["train", "fit"],
)
def test_a_second_run_in_a_folder_is_rejected(tmp_path, start):
    run = tmp_path / "run"
    with lock_folder(run), refused(ValueError, "another process"):
        start(tmp_path / "data", run)


@pytest.mark.parametrize("name", ["metrics.jsonl", "pictures", "tensorboard", ".lock"])
def test_nothing_is_written_through_a_link_in_a_strangers_run_folder(people, run, tmp_path, name, monkeypatch):
    diffuse_runs.make_small(monkeypatch)
    outside = tmp_path / "outside"
    if name in ("metrics.jsonl", ".lock"):
        outside.write_text("mine")
    else:
        outside.mkdir()
    (run / name).symlink_to(outside)
    with refused(FileError, name):
        train(diffuse_runs.settings(people, run))
    assert outside.read_text() == "mine" if outside.is_file() else not list(outside.iterdir())


@pytest.mark.parametrize("config", [TrainingConfig, FitConfig])
def test_the_folder_has_a_second_name_that_torchrun_does_not_take_for_its_own(config, tmp_path):
    launcher = pytest.importorskip("torch.distributed.run").get_args_parser()
    for name in ("--run", "--run-folder"):
        assert tyro.cli(config, args=["--data", "people", name, str(tmp_path)]).run == tmp_path
    command = ["--data", "people", "--run-folder", str(tmp_path)]
    assert launcher.parse_args(["-m", "primdiffusion", *command]).training_script_args == command


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


LINES = [{"step": 1, "loss": 0.5}, {"step": 2, "loss": 0.25, "rms_500": 0.1}]


def write_lines(run, tracker):
    PartialState()  # as a run has, and as tests before this one may have: trackers log through it
    config = settings(run, run, tracker=tracker)
    with open_metrics(config) as metrics:
        for line in LINES:
            metrics.append(line)
    assert rows(run) == LINES


def test_tensorboard_gets_every_number(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write_lines(tmp_path, "tensorboard")
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    for line in LINES:
        for name, value in line.items():
            sent = {event.step: event.value for event in events.Scalars(name)}
            assert sent[line["step"]] == pytest.approx(value, rel=1e-5)


def test_wandb_is_started_in_the_run_folder_and_gets_lines_as_they_are_written(tmp_path, monkeypatch):
    wandb = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    write_lines(tmp_path, "wandb")
    assert wandb.settings == {"project": "primdiffusion", "name": tmp_path.name, "dir": str(tmp_path)}
    assert wandb.lines == [(line["step"], line) for line in LINES]
    assert wandb.finished


def test_without_the_package_one_sentence_and_no_folder(people, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    config = settings(people, tmp_path / "run", tracker="wandb")
    with refused(MissingPackageError, '"primdiffusion[tracking]"'):
        train(config)
    assert not config.run.exists()


def test_a_run_may_go_on_with_another_tracker(tmp_path):
    before = settings(tmp_path, tmp_path / "run")
    check_resumable(to_json(before), settings(tmp_path, tmp_path / "run", tracker="wandb"))
