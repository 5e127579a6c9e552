"""Stage 2 on several processes, as `accelerate launch` or `torchrun` start them."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from diffuse_runs import DEFAULT_FILES, logged, make_small, settings
from diffusion_people import write_people
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.training.cells import CellTask
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.diffuse import MODEL, train
from primdiffusion.training.loop import step_seed
from safetensors.torch import load_file
from support.runs import child_environment

SCRIPT = Path(__file__).parents[1] / "diffuse_runs.py"
LOCAL = {"steps": 2, "batch": 4, "evaluate_every": 2}
TWINS = {step_seed(0, "local", step, 0): step_seed(0, "local", step, 1) for step in range(2)}
"""Seeds of the second process by those of the first."""
ALONE = CellTask.loss


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, geometries=16, variants=2)
    return folder


@pytest.fixture(autouse=True)
def small(monkeypatch):
    make_small(monkeypatch)


def of_both(task, step):
    """The mean of what two processes would compute, each with numbers of its own."""
    losses = []
    for seed in (step.generator.initial_seed(), TWINS[step.generator.initial_seed()]):
        torch.manual_seed(seed)
        losses.append(ALONE(task, dataclasses.replace(step, generator=torch.Generator().manual_seed(seed)))["loss"])
    return {"loss": torch.stack(losses).mean()}


@pytest.mark.slow
def test_two_processes_train_on_batches_of_their_own_and_average_gradients(people, tmp_path, monkeypatch):
    launcher = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--", str(SCRIPT))
    done = subprocess.run(
        [sys.executable, "-m", *launcher, str(people), str(tmp_path / "two"), json.dumps(LOCAL)],
        env=child_environment(), capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "two").iterdir()} == DEFAULT_FILES
    assert logged(tmp_path / "two") == [1, 2]
    assert json.loads((tmp_path / "two" / "run.json").read_text())["starts"][0]["processes"] == 2
    assert load_checkpoint(tmp_path / "two" / MODEL).card["batch"] == {"local": 8}
    monkeypatch.setattr(CellTask, "loss", of_both)
    train(settings(people, tmp_path / "one", local=NetworkTraining(**LOCAL)))
    states = [load_file(tmp_path / folder / "state.safetensors") for folder in ("two", "one")]
    for key, value in states[0].items():
        if key.startswith(("network.", "average.")):
            assert torch.allclose(value, states[1][key], atol=1e-5), key
