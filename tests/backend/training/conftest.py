"""Humans and captures to train on."""

import pytest
from capture_scenes import captured
from diffuse_runs import settings
from diffusion_people import write_people
from fit_scenes import make_small
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.training.cells import prepare
from primdiffusion.training.latents import split_people


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, geometries=16, variants=3)
    return folder


@pytest.fixture(scope="module")
def prepared_once(people, tmp_path_factory):
    config, found = settings(people, tmp_path_factory.mktemp("prepared")), PersonFolder(people)
    return config, prepare(config, found, *split_people(range(16), config.holdout, config.seed))


@pytest.fixture(scope="session")
def captures(tmp_path_factory):
    """Two people in two poses; not to be changed."""
    return captured(tmp_path_factory.mktemp("captures"), people=2, frames=2, passes=("img", "mask"))


@pytest.fixture
def small_fit(monkeypatch):
    make_small(monkeypatch)
