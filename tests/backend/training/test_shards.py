import errno
import itertools
import json
import os
import pathlib
import shutil

import numpy as np
import pytest
import torch
from diffusion_people import write_people
from primdiffusion.files import tensor_file
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.whole_files import temporary_name
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.primitives.primitives import K
from primdiffusion.training import shards
from primdiffusion.training.shards import INDEX, PackedPeople, damaged_shards, open_people, pack_people
from primdiffusion.training.stored_people import PersonFolder, read_person
from support.errors import refused


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five people, of whom the third has only one colouring and boxes of other sizes."""
    folder = tmp_path_factory.mktemp("people")
    write_people(folder, geometries=5, variants=2)
    path = folder / "person_000002.npz"
    with np.load(path) as file:
        entries = dict(file)
    sizes = np.random.default_rng(0).uniform(0.5, 2, (1, K, 3)).astype(np.float16)
    np.savez(path, **{**entries, "voxels": entries["voxels"][:1], "delta_scale": sizes})
    return folder


@pytest.fixture(scope="module")
def packed(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("packed") / "shards"
    assert list(pack_people(folder, out, people_each=2)) == [2, 4, 5]
    return out


@pytest.fixture
def copied(packed, tmp_path):
    return shutil.copytree(packed, tmp_path, dirs_exist_ok=True)


def change_index(packed, change) -> None:
    content = json.loads((packed / INDEX).read_text())
    change(content)
    (packed / INDEX).write_text(json.dumps(content))


def same(one, other):
    return (
        torch.equal(one.voxels, other.voxels)
        and torch.equal(one.delta_scale, other.delta_scale)
        and torch.equal(one.betas, other.betas)
        and (one.attributes, one.full_density) == (other.attributes, other.full_density)
    )


def test_packed_people_are_those_of_the_folder_bit_for_bit(folder, packed):
    files, people = open_people(folder), open_people(packed)
    assert isinstance(files, PersonFolder)
    assert isinstance(people, PackedPeople)
    assert sorted(path.name for path in packed.iterdir()) == [INDEX, *(f"shard_000{i}.safetensors" for i in range(3))]
    assert list(people.names) == list(files.names) == [f"person_00000{i}" for i in range(5)]
    assert list(people.variants) == list(files.variants) == [2, 2, 1, 2, 2]
    assert [people.known(index) for index in range(5)] == [files.known(index) for index in range(5)]
    assert people.full_density == files.full_density == 100
    for index in range(5):
        assert same(people.person(index), files.person(index))
        for number in range(people.variants[index]):
            one, other = people.variant(index, number), files.variant(index, number)
            assert torch.equal(one[0], other[0])
            assert torch.equal(one[1], other[1])
    assert (people.person(2).delta_scale != 1).any()
    assert (people.person(1).delta_scale == 1).all()


def test_stored_voxels_become_the_payload_they_came_from(folder):
    person = read_person(folder / "person_000002.npz")
    payload = person.payload(0).validate()
    assert torch.allclose(encode_srgb(payload.rgb[7, 1, 2, 3, 4]), person.voxels[0, 7, 2, 3, 4, 1] / 255, atol=1e-5)
    assert payload.density.max().item() == pytest.approx(int(person.voxels[0, ..., 3].max()) / 255 * 100, rel=1e-5)
    assert torch.equal(payload.delta_scale, person.delta_scale[0].float())


@pytest.mark.parametrize("harm", ["a flipped bit", "a cut", "no file"])
def test_a_damaged_shard_is_named_before_anything_of_it_is_used(copied, harm):
    path = copied / "shard_0001.safetensors"
    content = bytearray(path.read_bytes())
    content[-1000] ^= 1
    path.unlink()
    if harm != "no file":
        path.write_bytes(content if harm == "a flipped bit" else content[: len(content) // 2])
    people = open_people(copied)
    people.person(0)
    with refused((FileError, FileNotFoundError), "shard_0001"):
        people.variant(2, 0)
    assert [("shard_0001" in found) for found in damaged_shards(copied)] == [True]


def test_a_shard_is_checked_once(packed, monkeypatch):
    digests, digest = [], shards.digest_of
    monkeypatch.setattr(shards, "digest_of", lambda path: digests.append(path.name) or digest(path))
    people = open_people(packed)
    for index in (0, 1, 0, 4):
        people.person(index)
    assert digests == ["shard_0000.safetensors", "shard_0002.safetensors"]


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"format": "primdiffusion-payloads", "version": 9}',
        '{"format": "primdiffusion-payloads", "version": 1, "full_density": 100}',
    ],
)
def test_an_index_that_cannot_be_used_is_rejected(copied, content):
    (copied / INDEX).write_text(content)
    with refused(FileError):
        open_people(copied)


def test_shards_without_people_are_named(copied):
    change_index(copied, lambda index: index["shards"].clear())
    with refused(FileNotFoundError, "0 humans"):
        open_people(copied)


def test_a_damaged_person_is_named_and_leaves_no_index(folder, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "person_000003.npz"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    with refused(ValueError, "person_000003"):
        list(pack_people(tmp_path, tmp_path / "out", people_each=2))
    assert not (tmp_path / "out" / INDEX).exists()


@pytest.mark.parametrize("written", [1, 3], ids=["a shard", "the index"])
def test_a_full_disk_while_packing_is_named_and_leaves_nothing(folder, tmp_path, monkeypatch, written):
    write, calls = pathlib.Path.write_bytes, itertools.count()

    def until_full(path, data):
        if next(calls) == written:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, data)

    monkeypatch.setattr(pathlib.Path, "write_bytes", until_full)
    with refused(OSError, "space") as full:
        list(pack_people(folder, tmp_path / "out", people_each=2))
    assert full.value.filename == str(tmp_path / "out" / ("shard_0001.safetensors" if written == 1 else INDEX))
    assert not (tmp_path / "out").exists()


def test_packing_into_packed_people_is_rejected(folder, copied):
    before = (copied / INDEX).read_bytes()
    with refused(FileError, "already"):
        list(pack_people(folder, copied))
    assert (copied / INDEX).read_bytes() == before


def test_packing_again_removes_what_a_kill_left_beside_the_finished_shards(folder, copied):
    left = temporary_name(copied / "files")
    left = left.with_name(left.name.replace(str(os.getpid()), "9999999"))  # above any process' number
    left.mkdir()
    with refused(FileError, "already"):
        list(pack_people(folder, copied))
    assert not left.exists()


def test_people_of_several_densities_are_rejected(folder, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    with np.load(tmp_path / "person_000001.npz") as file:
        np.savez(tmp_path / "person_000001.npz", **{**file, "full_density": np.array(25.5)})
    with refused(ValueError, "25.5", "100"):
        open_people(tmp_path)


def test_delta_scales_of_another_shape_are_rejected(folder, tmp_path):
    with np.load(folder / "person_000001.npz") as file:
        np.savez(tmp_path / "person.npz", **file, delta_scale=np.ones((1, K, 3), np.float16))
    with refused(ValueError, "delta_scale"):
        read_person(tmp_path / "person.npz")


def test_the_index_is_plain_json_with_all_known_attributes(packed):
    index = json.loads((packed / INDEX).read_text())
    assert [len(shard["people"]) for shard in index["shards"]] == [2, 2, 1]
    assert index["shards"][0]["people"][1]["attributes"] == {"outfit": "outfit1"}
    assert all(len(shard["sha256"]) == 64 for shard in index["shards"])


@pytest.mark.parametrize("name", ["../shard_0000.safetensors", "/proc/self/pagemap", "a/b", "C:\\x", "", "..", 3])
def test_an_index_names_only_files_beside_it(copied, name):
    change_index(copied, lambda index: index["shards"][0].update(file=name))
    with refused(FileError, "index"):
        PackedPeople(copied)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("betas", torch.full((2, 10), torch.nan)),
        ("betas", torch.ones(2, 10).half()),
        ("voxels", torch.zeros(1, dtype=torch.uint8)),
    ],
)
def test_a_shard_with_the_right_checksum_and_other_tensors_is_rejected(copied, name, value):
    path = copied / "shard_0000.safetensors"
    tensors, _ = tensor_file.read(path)
    path.write_bytes(tensor_file.save({**tensors, name: value}))
    change_index(copied, lambda index: index["shards"][0].update(sha256=shards.digest_of(path)))
    with refused(FileError, "shard_0000"):
        PackedPeople(copied).person(0)


def test_a_shard_that_is_listed_twice_is_rejected(copied):
    change_index(copied, lambda index: index["shards"].append(index["shards"][0]))
    with refused(FileError, "shard_0000.safetensors"):
        PackedPeople(copied)


@pytest.mark.parametrize("variants", [0, -3, 1.5, "1", True])
def test_a_number_of_colourings_that_is_none_is_rejected(copied, variants):
    change_index(copied, lambda index: index["shards"][0]["people"][0].update(variants=variants))
    with refused(FileError, "colourings"):
        PackedPeople(copied)
