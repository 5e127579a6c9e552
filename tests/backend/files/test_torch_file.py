"""Files of torch.save: tensors are read, nothing in them is run, and no file takes more memory than it has."""

import pickle
import struct
import zipfile

import pytest
import torch
from primdiffusion.files import torch_file
from primdiffusion.files.regular_files import FileError
from support.errors import refused

HOSTILE = {
    "memory": b"\x80\x02cbuiltins\nbytearray\n\x8a\x08" + struct.pack("<q", 10**10) + b"\x85R.",
    "code": b"cos\nsystem\n(S'touch CANARY'\ntR.",
    "length": b"X" + struct.pack("<I", 2**32 - 1),
}


@pytest.mark.parametrize("legacy", [False, True])
def test_tensors_are_read(tmp_path, legacy):
    content = {"a": torch.arange(6.0).reshape(2, 3).half(), "b": torch.nn.Parameter(torch.ones(3)), "n": {"step": 3}}
    torch.save(content, tmp_path / "a.pt", _use_new_zipfile_serialization=not legacy)
    found = torch_file.load(tmp_path / "a.pt")
    assert isinstance(found, dict)
    assert torch.equal(found["a"], content["a"])
    assert torch.equal(found["b"], content["b"])
    assert found["n"] == {"step": 3}


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_pickle_is_not_run(tmp_path, content, zipped, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.pt"
    if zipped:
        archive_of(path, [("a/data.pkl", content), ("a/version", b"3"), ("a/byteorder", b"little")])
    else:
        head = (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})
        path.write_bytes(b"".join(pickle.dumps(part, 2) for part in head) + content)
    with refused(FileError, "a.pt"):
        torch_file.load(path)
    assert [file.name for file in tmp_path.iterdir()] == ["a.pt"]


def test_the_sentence_names_what_a_pickle_would_have_run(tmp_path):
    archive_of(tmp_path / "a.pt", [("a/data.pkl", HOSTILE["code"]), ("a/version", b"3")])
    with refused(FileError, "os.system", "nothing was executed"):
        torch_file.load(tmp_path / "a.pt")


def test_an_archive_that_unpacks_to_more_than_it_has_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1000)}, tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt") as stored, zipfile.ZipFile(tmp_path / "b.pt", "w", 8) as packed:
        for name in stored.namelist():
            packed.writestr(name, stored.read(name))
    with refused(FileError, "compressed"):
        torch_file.load(tmp_path / "b.pt")


def archive_of(path, members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def storage_pickle(count=b"K\x02", offset=b"K\x00", size=b"K\x02"):
    """A pickle of one tensor, as torch.save writes it: BININT1 are one byte, LONG1 eight."""
    return (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000"
        b"X\x03\x00\x00\x00cpu" + count + b"tQ" + offset + size + b"\x85K\x01\x85\x89ccollections\nOrderedDict\n)RtR."
    )


LARGE = b"\x8a\x08" + struct.pack("<q", 10**10)


@pytest.mark.parametrize("claim", [{}, {"size": LARGE}, {"offset": LARGE}, {"size": LARGE, "count": LARGE}])
def test_a_tensor_is_no_larger_than_the_numbers_in_the_file(tmp_path, claim):
    members = [("x/data.pkl", storage_pickle(**claim)), ("x/data/0", struct.pack("<2f", 1, 2)), ("x/version", b"3")]
    path = archive_of(tmp_path / "a.pt", members)
    if claim:
        with refused(FileError, "a.pt"):
            torch_file.load(path)
    else:
        found = torch_file.load(path)
        assert isinstance(found, torch.Tensor)
        assert found.tolist() == [1, 2]


def test_writing_to_what_was_loaded_leaves_the_file_as_it_is(tmp_path):
    torch.save({"a": torch.arange(6.0)}, tmp_path / "a.pt")
    content = (tmp_path / "a.pt").read_bytes()
    found = torch_file.load(tmp_path / "a.pt")
    assert isinstance(found, dict)
    found["a"][:] = -1
    assert (tmp_path / "a.pt").read_bytes() == content
