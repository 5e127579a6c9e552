"""Stored humans whose content cannot be."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from primdiffusion.training.stored_people import find_people, read_outline, read_person
from support.errors import refused


def test_an_empty_folder_is_rejected(tmp_path):
    with refused(FileNotFoundError, "primdiffusion"):
        find_people(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"full_density": np.array(-3.0)},
        {"full_density": np.array(np.nan)},
        {"full_density": np.zeros(2)},
        {"attributes": np.array("[" * 100_000)},
        {"attributes": np.array("[]")},
        {"attributes": np.array('{"variants": 3}')},
        {"attributes": np.array('{"variants": ["a"]}')},
        {"betas": np.full(10, 1e300)},
        {"voxels": np.array(3, np.uint8)},
        {"voxels": np.zeros((1, 3), np.uint8)},
    ],
)
def test_content_that_cannot_be_a_human_is_one_sentence(tmp_path, people, change):
    with np.load(people / "person_000000.npz") as stored:
        np.savez(tmp_path / "person_000009.npz", **{**stored, **change})
    for read in (read_person, read_outline):
        with refused(ValueError, "person_000009.npz") as raised:
            read(tmp_path / "person_000009.npz")
        assert len(str(raised.value)) - len(str(tmp_path)) < 300


def test_a_header_that_promises_many_humans_is_not_believed(tmp_path, people):
    path = tmp_path / "person_000009.npz"
    with np.load(people / "person_000000.npz") as stored:
        np.savez(path, **{name: values for name, values in stored.items() if name != "voxels"})
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (50000000, 1024, 8, 8, 8, 4), }\n"
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("voxels.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    for read in (read_person, read_outline):
        with refused(ValueError, path.name, "claims the shape"):
            read(path)
