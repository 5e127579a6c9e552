"""Latents of humans, split into training and held-out bodies."""

from __future__ import annotations

from primdiffusion.people.stored_people import find_payloads
from primdiffusion.training.latents import split_people


def test_held_out_geometries_are_never_trained_on(people):
    paths = find_payloads(people)
    train_paths, held = split_people(paths, 0.2, seed=0)
    assert len(held) == 3
    assert set(train_paths).isdisjoint(held)
    assert sorted(train_paths + held) == paths
    assert split_people(paths, 0.2, seed=0) == (train_paths, held)
    assert split_people(paths, 0.2, seed=1)[1] != held
