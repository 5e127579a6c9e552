"""Stored humans that are damaged or missing."""

from __future__ import annotations

import numpy as np
import pytest
from primdiffusion.training.stored_people import find_people, read_person


def test_a_damaged_person_is_named(tmp_path, people):
    path = tmp_path / "person_000009.npz"
    path.write_bytes((people / "person_000000.npz").read_bytes()[:2000])
    with pytest.raises(ValueError, match="person_000009"):
        read_person(path)
    np.savez(path, voxels=np.zeros((1, 3), np.uint8), betas=np.zeros(10), attributes=np.array("{}"), full_density=100.0)
    with pytest.raises(ValueError, match="voxels"):
        read_person(path)


def test_an_empty_folder_is_rejected(tmp_path):
    with pytest.raises(FileNotFoundError, match="primdiffusion payloads"):
        find_people(tmp_path)
