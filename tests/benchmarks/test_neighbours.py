"""Nearest stored samples in latent space."""

import pytest
import torch
from diffusion_people import write_people
from neighbours import nearest_stored
from primdiffusion.people.stored_people import find_people, read_person
from support.errors import refused
from tiny_model import tiny_model


def test_nearest_stored_person_of_a_stored_person_is_that_person(tmp_path):
    write_people(tmp_path, 6)
    paths, model = find_people(tmp_path), tiny_model()
    queries = torch.stack([model.encode(read_person(paths[number]).payload(1)).flatten() for number in (4, 2)])
    found = nearest_stored(queries, paths, model.encode)
    assert found.file.tolist() == [4, 2]
    assert found.colouring.tolist() == [1, 1]
    assert float(found.distance.max()) == pytest.approx(0, abs=1e-3)
    without = nearest_stored(queries, [*paths[:2], paths[3], paths[5]], model.encode)
    assert float(without.distance.min()) > 1e-3
    with refused(ValueError, "payload"):
        nearest_stored(queries, [], model.encode)
