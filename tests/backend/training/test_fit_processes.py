"""Stage 1 on several processes, as `accelerate launch` or `torchrun` start them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from capture_scenes import captured
from fit_scenes import STATE, WHOLE, files, flags, logged, settings
from primdiffusion.encoder.model import load_encoder
from primdiffusion.training.fit import MODEL, fit
from safetensors.torch import load_file
from support.runs import child_environment

pytestmark = pytest.mark.usefixtures("small_fit")

SCRIPT = Path(__file__).parents[1] / "fit_scenes.py"


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return captured(tmp_path_factory.mktemp("captures"), people=3, frames=2, passes=("img", "mask"))


def launched(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", *words],
        env=child_environment(),
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


@pytest.mark.slow
def test_two_processes_of_one_person_train_as_one_of_two_and_save_once(captures, tmp_path):
    config = settings(captures, tmp_path / "two", steps=2)
    launcher = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--")  # or --run reads as --run-path
    done = launched(*launcher, str(SCRIPT), "fit", *flags(config))
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{config.run / MODEL}  2 of 2 steps\n"
    assert files(config.run) == WHOLE
    assert logged(config.run) == [1, 2]
    assert json.loads((config.run / "run.json").read_text())["starts"][0]["processes"] == 2
    assert load_encoder(config.run / MODEL).card["batch"] == 2
    one = settings(captures, tmp_path / "one", steps=2, batch=2)
    fit(one)
    states = [load_file(run / STATE) for run in (config.run, one.run)]
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        if name.startswith(("network.", "average.")):
            assert torch.allclose(value, states[1][name], atol=1e-5), name


@pytest.mark.slow
def test_accelerate_launches_the_command(captures, tmp_path):
    config = settings(captures, tmp_path / "run", steps=1)
    words = ("accelerate.commands.launch", "--cpu", "--num_processes", "1", str(SCRIPT), "fit")
    done = launched(*words, *flags(config))
    assert done.returncode == 0, done.stderr
    assert files(config.run) == WHOLE
