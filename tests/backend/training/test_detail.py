"""A detail decoder: what it learns, that a run resumes exactly, and its checkpoint."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffuse_runs import make_small
from diffusion_people import small_model, write_people
from primdiffusion.diffusion.checkpoint import load_checkpoint, read_card, save_checkpoint
from primdiffusion.diffusion.codec import cells_from_voxels
from primdiffusion.diffusion.detail import DetailCodec, DetailConfig
from primdiffusion.diffusion.model import sample
from primdiffusion.diffusion.model_card import model_card
from primdiffusion.training.config import CodecConfig, PhaseConfig
from primdiffusion.training.detail import DetailTrainingConfig, train_detail
from primdiffusion.training.stored_people import read_person
from safetensors.torch import load_file

STEPS = 60


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DetailTrainingConfig:
    """A run on eight humans whose finer payloads have a stripe where the coarse ones are red."""
    make_small(monkeypatch)
    write_people(tmp_path / "coarse", 8)
    (tmp_path / "fine").mkdir()
    for path in (tmp_path / "coarse").iterdir():
        arrays = dict(np.load(path))
        stripe = arrays["voxels"][..., 0].astype(int) - 100
        arrays["voxels"][:, :, :, ::2, :, 1] = np.clip(
            arrays["voxels"][:, :, :, ::2, :, 1] + stripe[:, :, :, ::2], 0, 255
        )
        np.savez(tmp_path / "fine" / path.name, **{**arrays, "full_density": np.array(200.0)})
    save_checkpoint(tmp_path / "base.safetensors", small_model(), "linear")
    return DetailTrainingConfig(
        tmp_path / "fine",
        tmp_path / "coarse",
        tmp_path / "run",
        tmp_path / "base.safetensors",
        holdout=0.25,
        codec=CodecConfig(channels=6, people=4),
        model=DetailConfig(widths=(8, 8), position_channels=2, condition_width=8, heads=2),
        detail=PhaseConfig(steps=STEPS, batch=4, learning_rate=0.01, blend=0.5, evaluate_every=STEPS),
    )


def trained(config: DetailTrainingConfig, **changes: object) -> dict[str, torch.Tensor]:
    """The tensors of the model that a run writes."""
    train_detail(dataclasses.replace(config, **changes))
    return load_file(config.run / "model.safetensors")


def test_the_decoder_beats_the_linear_map_and_is_loaded_as_it_was_saved(config):
    model = train_detail(config)
    card = read_card(config.run / "model.safetensors")
    errors = card["held_out_rms_detail_error"]
    assert all(errors["decoder"][level] < errors["linear"][level] for level in ("60", "150", "300"))
    assert (card["full_density"], model.full_density) == (200, 200)
    assert card["detail_decoder"]["steps"] == STEPS
    loaded = load_checkpoint(config.run / "model.safetensors")
    assert isinstance(loaded.codec, DetailCodec)
    x0 = torch.randn(2, 4, 32, 32, generator=torch.Generator().manual_seed(0))
    one, other = model.decode(x0), loaded.decode(x0)
    torch.testing.assert_close(one.rgb, other.rgb, atol=0.03, rtol=0)  # weights are saved in half precision
    torch.testing.assert_close(loaded.decode(x0[1]).density, other.density[1], atol=0.5, rtol=0)
    *_, last = sample(loaded, [1], steps=2)
    assert torch.isfinite(loaded.decode(last.x0).rgb).all()
    assert "## Held-out error of the detail decoder" in model_card({**card, "held_out_rms_x0_error": {"x": {"0": 1.0}}})


def test_a_human_is_encoded_near_the_latents_that_it_was_decoded_from(config):
    model = train_detail(config)
    person = read_person(config.coarse / "person_000000.npz")
    latents = model.codec.codec.encode(cells_from_voxels(person.voxels, person.delta_scale))
    again = model.encode(model.decode(latents))
    assert (again - latents).square().mean() < 0.3 * latents.square().mean()


def test_a_run_resumes_bit_for_bit(config, tmp_path):
    whole = trained(config)
    parts = dataclasses.replace(config, run=tmp_path / "parts")
    trained(parts, minutes=0.0)
    assert json.loads((parts.run / "run.json").read_text())["starts"][0]["step"] == 0
    again = trained(parts)
    assert whole.keys() == again.keys()
    assert all(torch.equal(whole[name], again[name]) for name in whole)


def test_sets_of_other_humans_are_named(config):
    (config.coarse / "person_000007.npz").unlink()
    with pytest.raises(ValueError, match=r"holds 8 humans with 16 colourings, .* 7 with .*same seeds"):
        train_detail(config)
    assert not config.run.exists()


def test_the_decoder_of_a_model_is_replaced(config, tmp_path):
    first = train_detail(config)
    again = dataclasses.replace(config, checkpoint=config.run / "model.safetensors", run=tmp_path / "again")
    second = train_detail(again)
    torch.testing.assert_close(first.codec.fine.codec.basis, second.codec.fine.codec.basis)
    assert len(load_file(again.run / "model.safetensors")) == len(load_file(config.run / "model.safetensors"))


@pytest.mark.parametrize(("name", "value"), [("holdout", 1.0), ("log_every", 0), ("minutes", -1.0)])
def test_settings_out_of_range_are_named(config, name, value):
    with pytest.raises(ValueError, match=f"^{name} is {value}"):
        dataclasses.replace(config, **{name: value})
