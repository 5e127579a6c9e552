"""A run of stage 1: what it leaves, when it stops, what it says of bad input, and how several processes share it."""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from capture_scenes import captured, save_person
from fit_scenes import STATE, WHOLE, files, flags, forget_processes, logged, patched_person, settings, stop_after
from PIL import Image
from primdiffusion.capture.dataset import FIRST, SINGLE_PROCESS
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.encoder.config import PRESETS
from primdiffusion.encoder.model import load_encoder
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.runtime.worker_process import LOCK
from primdiffusion.training import fit as fit_module
from primdiffusion.training import run_folder
from primdiffusion.training.fit import MODEL, EncoderTask, fit, run
from primdiffusion.training.fit_config import FitConfig, LossConfig
from primdiffusion.training.fit_data import fit_batches
from primdiffusion.training.fit_losses import volume_loss
from primdiffusion.training.loop import begin_training
from primdiffusion.training.run_folder import METRICS, PICTURES, Metrics
from safetensors.torch import load_file
from support.errors import refused
from support.runs import child_environment, rows, sentence

pytestmark = pytest.mark.usefixtures("small_fit")

ROOT = Path(__file__).parents[3]
SCRIPT = Path(__file__).parents[1] / "fit_scenes.py"


@pytest.fixture
def own(captures, tmp_path):
    """Captures that a test may damage."""
    shutil.copytree(captures, tmp_path / "captures")
    return tmp_path / "captures"


def test_a_run_leaves_settings_versions_metrics_pictures_state_and_encoder(captures, tmp_path):
    config = settings(captures, tmp_path / "run", steps=4, evaluate_every=2, held=captures)
    model = fit(config)
    assert files(config.run) == WHOLE
    assert json.loads((config.run / "config.json").read_text())["learning_rate"] == 1e-4
    about = json.loads((config.run / "run.json").read_text())
    assert about["people"] == ["person_000000", "person_000001"]
    assert about["starts"][0].keys() >= {"torch", "accelerate", "python", "primdiffusion", "processes"}
    assert not (ROOT / ".git").exists() or about["starts"][0]["commit"]
    (picture,) = (config.run / PICTURES).iterdir()
    assert Image.open(picture).size == (5 * 24, 2 * 24)
    assert logged(config.run) == [1, 2, 3, 4]
    terms = {"rgb", "silhouette", "volume", "gradient"}
    assert rows(config.run)[0].keys() == {"step", "seconds_step", "seconds"} | terms
    measured = [row for row in rows(config.run) if "psnr_train" in row]
    assert [row["step"] for row in measured] == [2, 4]
    assert all(np.isfinite([row["psnr_train"], row["psnr_held"]]).all() for row in measured)
    assert load_encoder(config.run / MODEL).card["steps"] == model.card["steps"] == 4
    state, kept = load_file(config.run / STATE), load_file(config.run / MODEL)
    for key, value in kept.items():  # the average is what is kept
        assert torch.equal(state[f"average.{key}"].half(), value)
    assert any(not torch.equal(state[f"average.{key}"], state[f"network.{key}"]) for key in kept)


def test_training_goes_on_from_another_run(captures, tmp_path):
    first = fit(settings(captures, tmp_path / "first", steps=2))
    path = tmp_path / "first" / MODEL
    second = fit(settings(captures, tmp_path / "second", minutes=0.0, start=path))
    kept = load_encoder(path).encoder
    assert all(torch.equal(a, b) for a, b in zip(second.encoder.parameters(), kept.parameters(), strict=True))
    assert second.card["start"]["steps"] == 2
    assert first.card["start"] is None
    with refused(ValueError, str(path), "--ablation"):
        fit(settings(captures, tmp_path / "third", start=path, ablation="no_attention"))


def test_without_minutes_left_the_encoder_is_that_of_the_last_step(captures, tmp_path, monkeypatch):
    assert fit(settings(captures, tmp_path / "run", minutes=0.0)).card["steps"] == 0
    assert load_encoder(tmp_path / "run" / MODEL).card["steps"] == 0
    with stop_after(1):
        fit(settings(captures, tmp_path / "run"))
    assert fit(settings(captures, tmp_path / "run", minutes=0.0)).card["steps"] == 1
    assert load_encoder(tmp_path / "run" / MODEL).card["steps"] == 1


def test_bfloat16_trains_float32_weights_on_the_processor(captures, tmp_path):
    seen = set()

    def note(module, inputs, output):
        if isinstance(module, torch.nn.Linear):
            seen.add(output.dtype)

    hook = torch.nn.modules.module.register_module_forward_hook(note)
    with hook:
        config = settings(captures, tmp_path / "run", steps=2, mixed_precision="bf16")
        model = fit(config)
    assert torch.bfloat16 in seen
    assert {parameter.dtype for parameter in model.encoder.parameters()} == {torch.float32}
    assert all(np.isfinite(row["rgb"]) for row in rows(config.run) if "rgb" in row)


def test_the_perceptual_loss_is_read_from_its_file_and_counted(captures, tmp_path, monkeypatch):
    read = []

    class Brightness(torch.nn.Module):
        def forward(self, image, target):
            return (image.mean() - target.mean()).abs()

    monkeypatch.setattr(fit_module, "load_perceptual", lambda path: read.append(path) or Brightness())
    loss = LossConfig(perceptual=1.0, perceptual_weights=tmp_path / "vgg19.pth")
    fit(settings(captures, tmp_path / "run", steps=1, loss=loss))
    assert read == [tmp_path / "vgg19.pth"]
    assert rows(tmp_path / "run")[0]["perceptual"] > 0


def test_a_perceptual_weight_without_a_file_is_rejected_and_a_missing_file_named(captures, tmp_path):
    with refused(ValueError, "--loss.perceptual-weights"):
        settings(captures, tmp_path / "run", loss=LossConfig(perceptual=1.0))
    loss = LossConfig(perceptual=1.0, perceptual_weights=tmp_path / "nowhere.pth")
    with refused(FileNotFoundError, "nowhere.pth"):
        fit(settings(captures, tmp_path / "run", loss=loss))


def test_losses_without_colour_are_rejected():
    with refused(ValueError, "colours"):
        LossConfig(rgb=0.0)


def test_a_person_with_one_view_trains_on_it_again_and_again(own, tmp_path):
    for person in own.glob("person_*"):
        cameras = json.loads((person / "cameras.json").read_text())
        (person / "cameras.json").write_text(json.dumps({"camera0000": cameras["camera0000"]}))
    assert fit(settings(own, tmp_path / "run", steps=1, views=3, targets=2)).card["steps"] == 1


@pytest.mark.parametrize("workers", [0, 1])
def test_a_picture_that_goes_missing_is_named(own, tmp_path, workers):
    for path in own.glob("person_000001/img/*/0001.*"):
        path.unlink()
    with pytest.raises(FileNotFoundError) as error:
        fit(settings(own, tmp_path / "run", workers=workers))
    assert sentence(error.value).endswith("is missing: render the subject again")
    assert sentence(error.value).startswith(str(own / "person_000001" / "img"))


def test_a_human_on_another_body_is_named_before_training_begins(own, tmp_path):
    path = own / "person_000001" / "outputs_re_fitting"
    (plain,) = path.glob("*plain*.npz")
    with np.load(plain) as arrays:
        changed = {**arrays, "betas": np.zeros((1, 16))}
    np.savez(plain, **changed)
    with refused(ValueError, "person_000001", "16 betas"):
        fit(settings(own, tmp_path / "run"))
    assert os.listdir(tmp_path / "run") == [LOCK]
    with refused(ValueError, "person_000001", "16 betas"):
        fit(settings(own, tmp_path / "run", held=own))


@pytest.mark.parametrize(("batch", "remedy"), [(4, "--batch 2"), (1, "fewer --targets")])
def test_too_little_memory_says_what_to_try(captures, tmp_path, monkeypatch, batch, remedy):
    def full(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")

    monkeypatch.setattr(EncoderTask, "loss", full)
    with pytest.raises(ValueError) as error:
        fit(settings(captures, tmp_path / "run", batch=batch))
    assert remedy in sentence(error.value)


def test_a_loss_that_is_not_finite_is_named_and_nothing_is_saved(captures, tmp_path, monkeypatch):
    fit(settings(captures, tmp_path / "run", steps=2))
    before = {name: (tmp_path / "run" / name).read_bytes() for name in (STATE, MODEL)}
    monkeypatch.setattr(
        fit_module, "loss_terms", lambda *_: {"rgb": torch.tensor(1.0), "volume": torch.tensor(float("nan"))}
    )
    with refused(ValueError, "(volume)", "step 2") as error:
        fit(settings(captures, tmp_path / "run", steps=3))
    assert "(volume) at step 2 is not finite" in sentence(error.value)
    assert all((tmp_path / "run" / name).read_bytes() == content for name, content in before.items())


def test_metrics_that_find_no_room_name_their_file(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "open_to_append", Mock(side_effect=OSError(errno.ENOSPC, "no space left")))
    with refused(OSError, str(tmp_path / METRICS)):
        Metrics(tmp_path).append({"step": 1})


def test_the_command_says_where_the_encoder_is(captures, tmp_path, capsys):
    run([*flags(settings(captures, tmp_path / "run", steps=1)), "--loss.silhouette", "0.01"])
    assert capsys.readouterr().out == f"{tmp_path / 'run' / MODEL}  1 of 1 steps\n"


def test_held_boxes_are_drawn_as_large_as_they_start_and_then_learn(captures, tmp_path):
    terms = {}
    for hold_scale in (1, 0):
        config = settings(captures, tmp_path / "run", hold_scale=hold_scale)
        task = first_task(config)
        state = begin_training(task, task.accelerator)
        sample, _ = next(fit_batches(task.dataset, config, FIRST, SINGLE_PROCESS))
        with torch.no_grad():
            state.network.scale_out.bias.fill_(30.0)  # as if boxes had learned to be larger
        terms[hold_scale] = task.terms(sample, 0)
        start = sample.frames.half_extent * torch.tensor(PRESETS["default"].extent)
    assert torch.allclose(terms[1]["volume"], config.loss.volume * volume_loss(start))
    assert terms[0]["volume"] > 1.2 * terms[1]["volume"]


def test_biases_of_places_learn_so_many_times_as_fast_as_weights(captures, tmp_path):
    config = settings(captures, tmp_path / "run", place_rate=50.0)
    task = first_task(config)
    state = begin_training(task, task.accelerator)
    before = {name: value.detach().clone() for name, value in state.network.named_parameters()}
    state.update(sum(value.sum() for value in state.network.parameters()))
    after = {name: value.detach() for name, value in state.network.named_parameters()}
    moved = {name: float((value - before[name]).abs().max()) for name, value in after.items()}
    weight, place = (moved[f"scale_out.{part}"] for part in ("convolution.parametrizations.weight.original1", "bias"))
    assert place / weight == pytest.approx(50, rel=0.01)
    assert moved["colour.up.0.bias"] == pytest.approx(place, rel=0.01)


def first_task(config: FitConfig) -> EncoderTask:
    return EncoderTask(config, open_captures(config.data), Accelerator(cpu=True))


def launched(*words: str) -> subprocess.CompletedProcess:
    """A run as `accelerate launch` or `torchrun` start it."""
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, env=child_environment(), capture_output=True, text=True, timeout=500, check=False)


@pytest.mark.slow
def test_two_processes_of_one_person_train_as_one_of_two_and_save_once(tmp_path):
    captures = captured(tmp_path / "captures", people=3, frames=2, passes=("img", "mask"))
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


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_default_encoder_overfits_one_person_beyond_32_db(tmp_path):
    people = {"person_000000": save_person(tmp_path / "person.glb", patched_person())}
    poses = built_in_poses().map(lambda values: values[:2])
    job = RenderJob(people, poses, tmp_path / "captures", Rig("sphere", 12, width=256, height=256), ("img", "mask"))
    assert [outcome.status for outcome in render(job)] == ["done"]
    forget_processes()
    torch.manual_seed(0)
    config = FitConfig(
        data=job.out, run=tmp_path / "run", steps=150, batch=1,
        views=8, targets=4, size=192, conditioning_frame="first",
        learning_rate=1e-3, place_rate=1.0, hold_scale=20, ema=0.9, log_every=10, evaluate_every=25, pictures_every=75,
    )  # fmt: skip
    fit(config)
    psnr = [row["psnr_train"] for row in rows(config.run) if "psnr_train" in row]
    assert psnr[-1] >= 32, psnr  # 31.1 untrained
