"""Runs of stage 2: what they leave, how they go on, what they refuse, and how processes share them; both presets."""

import dataclasses
import itertools
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from diffuse_runs import DEFAULT_FILES, TINY_UNET, logged, make_small, settings
from diffusion_people import write_people
from PIL import Image
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.codec import codec_regions
from primdiffusion.diffusion.pretrained import model_card
from primdiffusion.human import generate
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.primitives import S
from primdiffusion.training import diffusion_task
from primdiffusion.training.cells import CellTask, prepare
from primdiffusion.training.config import NetworkTraining, PriorConfig
from primdiffusion.training.diffuse import DISTANCE_LIMIT, MODEL, train
from primdiffusion.training.diffusion_task import SlabTask
from primdiffusion.training.loop import Interrupt, TrainingStep, step_seed
from primdiffusion.training.losses import LEVELS
from safetensors.torch import load_file
from support.errors import refused
from support.runs import child_environment, rows, same_tensors, sentence, timeless

DIES_IN_THE_FIFTH_SAVE = """
import os, signal, sys
from pathlib import Path
import pytest
from diffuse_runs import make_small, settings
from primdiffusion.training.diffuse import train

make_small(pytest.MonkeyPatch())
whole, saves = Path.write_bytes, []

def write(path, content):
    if "state" in path.name:
        saves.append(path)
        if len(saves) == 5:
            whole(path, content[: len(content) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
    return whole(path, content)

Path.write_bytes = write
train(settings(Path(sys.argv[1]), Path(sys.argv[2]), save_every=0.0))
"""


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """For the paper's preset."""
    folder = tmp_path_factory.mktemp("few")
    write_people(folder, geometries=3, variants=2)
    return folder


@pytest.fixture(autouse=True)
def small(monkeypatch):
    make_small(monkeypatch)


def after(steps):
    """An interrupt that comes after so many steps."""
    asked = []
    return lambda self: asked.append(0) or len(asked) > steps


def first_step():
    return TrainingStep(0, torch.Generator().manual_seed(0), {})


def test_a_run_leaves_settings_people_metrics_pictures_states_and_a_model(people, whole):
    assert {path.name for path in whole.iterdir()} == DEFAULT_FILES
    assert json.loads((whole / "config.json").read_text())["local"]["steps"] == 10
    about = json.loads((whole / "run.json").read_text())
    assert about["people"] == [path.stem for path in sorted(people.iterdir())]
    assert len(about["held"]) == 3
    (start,) = about["starts"]
    assert (start["step"], start["processes"]) == (0, 1)
    assert start.keys() >= {"torch", "accelerate", "python", "primdiffusion"}
    assert logged(whole) == list(range(1, 11))
    measured = [row for row in rows(whole) if "rms_500" in row]
    assert [row["step"] for row in measured] == [5, 10]
    assert all(np.isfinite(row["rms_500"]) for row in measured)
    pictures = sorted(path.name for path in (whole / "pictures").iterdir())
    assert pictures == ["0000010.png"]
    assert Image.open(whole / "pictures" / pictures[0]).size == (24, 40)


def test_the_card_tells_data_settings_and_errors(whole):
    card = load_checkpoint(whole / MODEL).card
    errors = card["held_out_rms_x0_error"]
    assert errors.keys() == {"gaussian", "mixture", "denoiser"}
    assert {int(level) for level in errors["gaussian"]} == set(LEVELS)
    assert card["steps"] == {"local": 10}
    assert (card["geometries"], card["people"], card["held_out_geometries"]) == (13, 39, 3)
    assert card["licence"] == "CC0-1.0"
    assert "4 of 2051 numbers" in " ".join(card["limits"])
    assert DISTANCE_LIMIT in card["limits"]
    assert f"{errors['gaussian']['500']:.4f}" in model_card(card)


def test_the_distance_on_the_card_is_that_of_the_heads_voxels():
    of_the_head = default_anchors().rest_half_extent[codec_regions() == 1, :2]
    voxel_m = float((2 * of_the_head / (S - 1)).mean())
    assert f"{1000 * voxel_m:.0f} mm wide" in DISTANCE_LIMIT
    assert voxel_m * 50 / 36 * 1920 == pytest.approx(20, abs=1)


def test_a_card_claims_nothing_of_people_it_does_not_know(people, run):
    card = train(settings(people, run, minutes=0.0)).card
    assert not card.keys() & {"licence", "data", "limits"}
    assert card["steps"] == {"local": 0}


def test_a_new_run_starts_from_a_checkpoints_closed_form_and_weights(people, whole, tmp_path):
    base = load_checkpoint(whole / MODEL)
    config = settings(people, tmp_path / "run", start_from=whole / MODEL, local=NetworkTraining(steps=1, batch=4))
    folder = PersonFolder(people)
    task = CellTask(config, prepare(config, folder, [0, 1], [2], base), torch.device("cpu"), base)
    for name, value in task.denoiser.state_dict().items():
        assert torch.equal(value, base.denoiser.state_dict()[name]), name
    assert torch.equal(task.codec.basis, base.codec.codec.basis)
    assert task.vocabulary == base.vocabulary
    model = train(config)
    assert model.card["started_from"] == base.card["sha256"]
    assert torch.equal(model.denoiser.prior.basis, base.denoiser.prior.basis)


def test_a_checkpoint_of_other_slabs_or_densities_is_no_start(people, few, paper, whole, tmp_path):
    with refused(ValueError, "checkpoint"):
        train(settings(people, tmp_path / "run", start_from=paper / MODEL))
    denser = dataclasses.replace(load_checkpoint(whole / MODEL), full_density=1.0)
    with refused(ValueError, "1.0"):
        prepare(settings(people, tmp_path / "other"), PersonFolder(people), [0, 1], [2], denser)


def test_a_kill_in_the_middle_of_a_save_loses_one_interval(people, whole, run):
    died = subprocess.run(
        [sys.executable, "-c", DIES_IN_THE_FIFTH_SAVE, str(people), str(run)],
        env=child_environment(), capture_output=True, timeout=500, check=False,
    )  # fmt: skip
    assert died.returncode == -signal.SIGKILL
    assert logged(run) == list(range(1, 6))
    assert len(list(run.glob(".*.partial*"))) == 1
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"step": 6, "lo')
    train(settings(people, run))
    assert {path.name for path in run.iterdir()} == DEFAULT_FILES
    assert same_tensors(run / MODEL, whole / MODEL)
    assert same_tensors(run / "state.safetensors", whole / "state.safetensors")
    assert timeless(run) == timeless(whole)


def test_other_people_or_settings_in_the_same_folder_are_rejected(people, few, run):
    train(settings(people, run, minutes=0.0))
    with refused(ValueError, "(16 and 3 humans)"):
        train(settings(few, run))
    with refused(ValueError, "default"):
        train(settings(people, run, preset="paper"))
    slower = NetworkTraining(steps=10, batch=4, learning_rate=1e-5)
    with refused(ValueError, "local.learning_rate"):
        train(settings(people, run, local=slower))


@pytest.mark.parametrize("name", ["config.json", "run.json", "prepared.safetensors", "state.safetensors"])
def test_a_damaged_file_of_the_run_is_named(people, whole, tmp_path, name):
    shutil.copytree(whole, tmp_path / "run")
    path = tmp_path / "run" / name
    path.write_bytes(damaged := path.read_bytes()[:30])
    with refused(ValueError, "damaged") as error:
        train(settings(people, tmp_path / "run"))
    assert str(tmp_path / "run") in sentence(error.value)
    assert path.read_bytes() == damaged


def test_steps_draw_other_numbers_on_every_process_and_for_every_network():
    places = itertools.product((0, 1), ("local", "slab"), range(50), range(3))
    seeds = {step_seed(*place) for place in places}
    assert len(seeds) == 600
    assert all(0 <= seed < 2**63 for seed in seeds)


@pytest.fixture(scope="module")
def paper(few, tmp_path_factory):
    """A run of the paper's preset with a small network."""
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch)
        config = settings(few, tmp_path_factory.mktemp("paper") / "run", preset="paper")
        train(config)
        return config.run


def test_the_paper_preset_trains_saves_loads_and_generates(paper):
    assert logged(paper) == [1, 2]
    assert [path.name for path in (paper / "pictures").iterdir()] == ["0000002.png"]
    model = load_checkpoint(paper / MODEL)
    assert model.denoiser.config == TINY_UNET
    assert model.card["preset"] == "paper"
    assert model.card["people"] == 4
    assert np.isfinite(list(model.card["held_out_rms_x0_error"]["denoiser"].values())).all()
    human = generate(model, 3, steps=1)
    assert human.payload.validate().density.shape == (1024, 8, 8, 8)


@pytest.mark.slow
def test_the_paper_preset_goes_on_bit_for_bit(few, paper, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Interrupt, "due", after(1))
        train(settings(few, tmp_path / "run", preset="paper"))
    train(settings(few, tmp_path / "run", preset="paper"))
    for name in ("state.safetensors", MODEL):
        assert same_tensors(tmp_path / "run" / name, paper / name)


def test_the_paper_preset_learns_slabs_of_the_people(few):
    config = settings(few, Path("unused"), preset="paper")
    task = SlabTask(config, PersonFolder(few), [0, 2], [1], torch.device("cpu"))
    assert task.places == [(0, 0), (0, 1), (2, 0), (2, 1)]
    (slab,) = task.slabs([(2, 1)])
    payload = task.model().decode(slab)
    stored = PersonFolder(few).person(2).payload(1)
    for name in ("rgb", "density", "delta_scale"):
        assert torch.allclose(getattr(payload, name), getattr(stored, name), atol=1e-4), name


def test_an_untrained_paper_network_has_the_loss_of_guessing_nothing(few):
    # it starts at 0, so the plain error is the mean square of the slabs themselves, at any level
    config = settings(few, Path("unused"), preset="paper", slab=NetworkTraining(steps=1, batch=2))
    task = SlabTask(config, PersonFolder(few), [0], [1], torch.device("cpu"))
    energy = task.slabs([(0, 0)]).square().mean().item(), task.slabs([(0, 1)]).square().mean().item()
    loss = task.loss(first_step())["loss"].item()
    assert min(energy) - 1e-6 <= loss <= max(energy) + 1e-6


@pytest.mark.parametrize(("fast", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_bfloat16_computes_the_network_in_it_where_that_is_faster(few, monkeypatch, fast, dtype):
    monkeypatch.setattr(diffusion_task, "has_fast_bfloat16", lambda device: fast)
    config = settings(few, Path("unused"), preset="paper", slab=NetworkTraining(steps=1, batch=1, bfloat16=True))
    task = SlabTask(config, PersonFolder(few), [0], [1], torch.device("cpu"))
    seen, layer = [], torch.nn.Conv2d(56, 56, 1)  # processors are slow at convolutions in bfloat16

    def network(x, t):
        seen.append((out := layer(x)).dtype)
        return out

    task.denoiser = network
    loss = task.loss(first_step())["loss"]
    assert seen == [dtype]
    assert loss.dtype == torch.float32


@pytest.mark.parametrize("variants", [1, 2])
def test_too_few_humans_for_the_person_components_are_counted_before_anything_is_computed(tmp_path, variants):
    write_people(tmp_path / "people", geometries=6, variants=variants)
    with refused(ValueError, "5 humans", f"{5 * variants} colourings", "192", "--prior.components"):
        train(settings(tmp_path / "people", tmp_path / "run", prior=PriorConfig()))
    assert not (tmp_path / "run" / "prepared.safetensors").exists()


SCRIPT = Path(__file__).parents[1] / "diffuse_runs.py"
LOCAL = {"steps": 2, "batch": 4, "evaluate_every": 2}
TWINS = {step_seed(0, "local", step, 0): step_seed(0, "local", step, 1) for step in range(2)}
"""Seeds of the second process by those of the first."""
ALONE = CellTask.loss


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
