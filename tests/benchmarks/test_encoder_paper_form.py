"""The ablations of Table 3 in the paper's form: trained for their time, compared in poses that training had not."""

import argparse

import encoder_paper_form
import fit_scenes
import pytest
from capture_scenes import captured
from encoder_paper_form import FORMS, figures_of, measured, train
from primdiffusion.capture.reader import open_captures
from primdiffusion.encoder.config import PAPER, PRESETS, encoder_config
from tiny_encoder import TINY


def test_forms_differ_from_the_papers_in_one_setting():
    forms = {name: vars(encoder_config("paper", ablation)) for name, ablation in FORMS.items()}
    paper = vars(PAPER)
    found = {name: {key for key in paper if form[key] != paper[key]} for name, form in forms.items()}
    expected = {
        "full": set(),
        "shared_scale": {"delta_scale"},
        "template_rt": {"frames"},
        "no_attention": {"attention"},
    }
    assert found == expected


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return captured(tmp_path_factory.mktemp("captures"), people=2, frames=2, passes=("img", "mask"))


def test_a_form_is_trained_and_compared(captures, tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "paper", TINY)
    few = {**fit_scenes.FEW, "threads": 1}

    def settings(arguments, ablation, count):
        return fit_scenes.settings(captures, tmp_path / "run", **{**few, "steps": count, "encoder": "paper"})

    monkeypatch.setattr(encoder_paper_form, "settings", settings)
    fit_scenes.forget_processes()
    arguments = argparse.Namespace(minutes=0.001, given=1, cameras=1, compared_size=16)
    path = tmp_path / "full.safetensors"
    train(arguments, None, open_captures(captures), path)
    figures = figures_of("full", path, measured(path, open_captures(captures), arguments))
    assert figures["steps_full"] >= 1
    assert 0 < figures["psnr_full"] < 60
    assert figures["pictures_full"] >= 1
