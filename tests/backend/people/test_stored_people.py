"""Stored humans whose content cannot be."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusion_people import write_people
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.people.stored_people import PersonFolder, find_payloads, read_outline, read_payloads
from primdiffusion.primitives.primitives import K
from support.errors import refused


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, geometries=2, variants=2)
    return folder


def test_an_empty_folder_is_rejected(tmp_path):
    with refused(FileNotFoundError, "primdiffusion"):
        find_payloads(tmp_path)


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
    for read in (read_payloads, read_outline):
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
    for read in (read_payloads, read_outline):
        with refused(ValueError, path.name, "claims the shape"):
            read(path)


@pytest.fixture
def scaled(people, tmp_path) -> Path:
    """Two people, of whom the second has boxes of other sizes."""
    for number in range(2):
        with np.load(people / f"person_00000{number}.npz") as stored:
            entries = dict(stored)
        if number:
            shape = (len(entries["voxels"]), K, 3)
            entries["delta_scale"] = np.random.default_rng(0).uniform(0.5, 2, shape).astype(np.float16)
        np.savez_compressed(tmp_path / f"person_00000{number}.npz", **entries)
    return tmp_path


def test_one_colouring_is_that_of_the_whole_person(scaled):
    folder = PersonFolder(scaled)
    for index in range(2):
        person = folder.person(index)
        assert folder.variants[index] == len(person.voxels)
        for number in range(folder.variants[index]):
            voxels, scale = folder.variant(index, number)
            assert torch.equal(voxels, person.voxels[number])
            assert torch.equal(scale, person.delta_scale[number])
    assert (folder.person(0).delta_scale == 1).all()
    assert (folder.person(1).delta_scale != 1).any()


def test_stored_voxels_become_the_payload_they_came_from(scaled):
    person = read_payloads(scaled / "person_000001.npz")
    payload = person.payload(0).validate()
    assert torch.allclose(encode_srgb(payload.rgb[7, 1, 2, 3, 4]), person.voxels[0, 7, 2, 3, 4, 1] / 255, atol=1e-5)
    assert payload.density.max().item() == pytest.approx(int(person.voxels[0, ..., 3].max()) / 255 * 100, rel=1e-5)
    assert torch.equal(payload.delta_scale, person.delta_scale[0].float())


def test_voxels_that_were_damaged_on_disk_are_named(scaled):
    path, folder = scaled / "person_000001.npz", PersonFolder(scaled)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    for read in (folder.person, lambda index: folder.variant(index, 0)):
        with refused(ValueError, "person_000001"):
            read(1)


def test_people_of_several_densities_are_rejected(scaled):
    with np.load(scaled / "person_000001.npz") as stored:
        np.savez(scaled / "person_000001.npz", **{**stored, "full_density": np.array(25.5)})
    with refused(ValueError, "25.5", "100"):
        PersonFolder(scaled)


def test_delta_scales_of_another_shape_are_rejected(scaled):
    with np.load(scaled / "person_000001.npz") as stored:
        np.savez(scaled / "person.npz", **{**stored, "delta_scale": np.ones((1, K, 4), np.float16)})
    with refused(ValueError, "delta_scale"):
        read_payloads(scaled / "person.npz")
