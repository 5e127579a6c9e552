"""Humans and captures to train on."""

import os

import pytest
from capture_scenes import captured
from diffuse_runs import make_small as make_diffusion_small
from diffuse_runs import settings
from diffusion_people import write_people
from fit_scenes import make_small
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.training.cells import prepare
from primdiffusion.training.diffuse import train
from primdiffusion.training.latents import split_people


@pytest.fixture(scope="session")
def people(tmp_path_factory):
    """48 people; not to be changed."""
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, geometries=16, variants=3)
    return folder


@pytest.fixture(scope="session")
def prepared_once(people, whole):
    """The closed-form part of that run."""
    config, found = settings(people, whole), PersonFolder(people)
    return config, prepare(config, found, *split_people(range(16), config.holdout, config.seed))


@pytest.fixture(scope="session")
def whole(people, tmp_path_factory):
    """A run of stage 2 that nothing disturbed."""
    with pytest.MonkeyPatch.context() as patch:
        make_diffusion_small(patch)
        config = settings(people, tmp_path_factory.mktemp("whole") / "run", made_of="makehuman")
        train(config)
        return config.run


@pytest.fixture
def run(whole, tmp_path):
    """The folder of a run in which the closed-form part is done already."""
    folder = tmp_path / "run"
    folder.mkdir()
    os.link(whole / "prepared.safetensors", folder / "prepared.safetensors")
    return folder


@pytest.fixture(scope="session")
def captures(tmp_path_factory):
    """Two people in two poses; not to be changed."""
    return captured(tmp_path_factory.mktemp("captures"), people=2, frames=2, passes=("img", "mask"))


@pytest.fixture
def small_fit(monkeypatch):
    make_small(monkeypatch)
