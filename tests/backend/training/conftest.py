"""Humans to train on."""

import pytest
from diffuse_runs import settings
from diffusion_people import write_people
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
