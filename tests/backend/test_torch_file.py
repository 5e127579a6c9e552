"""Files of torch.save: tensors are read, constructors that take memory are not called."""

import importlib.util
import io
import os
import pickle
import struct
import sys
import types
import warnings
import zipfile

import pytest
import torch
from primdiffusion import torch_file
from primdiffusion.formats.regular_files import FileError
from support.errors import refused


@pytest.fixture(params=["private", "public"], autouse=True)
def unpickler(request, monkeypatch):
    """Every test is run with torch's private unpickler, and as if this torch had none."""
    if request.param == "public":
        monkeypatch.setattr(torch_file, "_weights_only_unpickler", None)
    return request.param


HOSTILE = {
    "memory": b"\x80\x02cbuiltins\nbytearray\n\x8a\x08" + struct.pack("<q", 10**10) + b"\x85R.",
    "code": b"cos\nsystem\n(S'touch CANARY'\ntR.",
    "meta tensor": b"\x80\x02ctorch._utils\n_rebuild_meta_tensor_no_storage\n)R.",
    "tensor type": b"\x80\x02ctorch\nFloatTensor\nJ\xff\xff\xff\x7f\x85R.",
    "operations": b"(" * (torch_file.MOST_OPERATIONS + 1),
    "length": b"\x8e" + struct.pack("<Q", 2**60),
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
def test_a_hostile_pickle_is_refused_before_it_is_run(tmp_path, content, zipped, monkeypatch):
    monkeypatch.setattr(torch, "load", lambda *_args, **_more: pytest.fail("it was loaded"))
    path = tmp_path / "a.pt"
    if zipped:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", content)
    else:
        head = (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})
        path.write_bytes(b"".join(pickle.dumps(part, 2) for part in head) + content)
    with pytest.raises(torch_file.PICKLE_ERRORS):
        torch_file.load(path)


def test_an_archive_that_unpacks_to_more_than_it_has_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1000)}, tmp_path / "a.pt")
    with zipfile.ZipFile(tmp_path / "a.pt") as stored, zipfile.ZipFile(tmp_path / "b.pt", "w", 8) as packed:
        for name in stored.namelist():
            packed.writestr(name, stored.read(name))
    with refused(ValueError, "compressed"):
        torch_file.load(tmp_path / "b.pt")


SAVED = {"a": torch.arange(1000.0), "b": torch.arange(6)}


def members_of(content, **options):
    """The archive of `content` in parts: name and bytes of its members."""
    saved = io.BytesIO()
    torch.save(content, saved, **options)
    with zipfile.ZipFile(saved) as archive:
        return [(name, archive.read(name)) for name in archive.namelist()]


def archive_of(path, members):
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, content in members:
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize(
    "name", ["archive/data.pkl", "ARCHIVE/data.pkl", "archive/DATA.pkl", "archive\\data.pkl", "archive/data.pkl?.txt"]
)
def test_two_members_of_what_torch_takes_for_one_name_are_refused(tmp_path, name, first):
    members = members_of(SAVED)
    members.insert(0 if first else len(members), (name, HOSTILE["memory"]))
    path = archive_of(tmp_path / "a.pt", members)
    path.write_bytes(path.read_bytes().replace(b"data.pkl?.txt", b"data.pkl\0.txt"))  # readers end names at a null
    with refused(FileError, "a.pt"):
        torch_file.load(path)


def test_of_two_archives_in_a_file_the_checked_one_is_loaded(tmp_path):
    """Readers differ in which they take, and in how they count offsets."""
    path = archive_of(tmp_path / "a.pt", members_of(SAVED))
    hostile = archive_of(tmp_path / "b.pt", [("archive/data.pkl", HOSTILE["memory"])]).read_bytes()
    content = path.read_bytes()
    path.write_bytes(hostile + content)
    found = torch_file.load(path)
    assert isinstance(found, dict)
    assert torch.equal(found["a"], SAVED["a"])
    path.write_bytes(content + hostile)
    with pytest.raises(torch_file.PICKLE_ERRORS):
        torch_file.load(path)


@pytest.mark.parametrize("legacy", [False, True])
def test_a_file_that_takes_the_name_of_another_is_not_loaded(tmp_path, monkeypatch, legacy):
    path, other = tmp_path / "a.pt", tmp_path / "b.pt"
    torch.save(SAVED, path, _use_new_zipfile_serialization=not legacy)
    torch.save({"a": torch.zeros(1000)}, other, _use_new_zipfile_serialization=not legacy)
    check = torch_file._check

    def checked_then_replaced(source):
        check(source)
        if other.exists():
            os.replace(other, path)

    monkeypatch.setattr(torch_file, "_check", checked_then_replaced)
    found = torch_file.load(path)
    assert isinstance(found, dict)
    assert found["a"].equal(SAVED["a"])
    assert torch.load(path)["a"].equal(torch.zeros(1000))


@pytest.mark.parametrize("hostile", HOSTILE)
def test_the_keys_of_storages_are_checked_too(tmp_path, monkeypatch, hostile):
    """Files of torch before 1.6 hold a fifth pickle, after that of the content."""
    monkeypatch.setattr(torch, "load", lambda *_args, **_more: pytest.fail("it was loaded"))
    parts = (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}, {"n": 1})
    (tmp_path / "a.pt").write_bytes(b"".join(pickle.dumps(part, 2) for part in parts) + HOSTILE[hostile])
    with pytest.raises(torch_file.PICKLE_ERRORS):
        torch_file.load(tmp_path / "a.pt")


def storage_pickle(count=b"K\x02", offset=b"K\x00", size=b"K\x02"):
    """A pickle of one tensor, as torch.save writes it: BININT1 are one byte, LONG1 eight."""
    return (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000"
        b"X\x03\x00\x00\x00cpu" + count + b"tQ" + offset + size + b"\x85K\x01\x85\x89ccollections\nOrderedDict\n)RtR."
    )


LARGE = b"\x8a\x08" + struct.pack("<q", 10**10)


@pytest.mark.parametrize("claim", [{}, {"count": LARGE}, {"size": LARGE}, {"offset": LARGE}, {"count": b"K\xff"}])
def test_a_tensor_is_no_larger_than_the_numbers_in_the_file(tmp_path, claim):
    members = [("x/data.pkl", storage_pickle(**claim)), ("x/data/0", struct.pack("<2f", 1, 2)), ("x/version", b"3")]
    path = archive_of(tmp_path / "a.pt", members)
    if claim:
        with pytest.raises(torch_file.PICKLE_ERRORS):
            torch_file.load(path)
    else:
        found = torch_file.load(path)
        assert isinstance(found, torch.Tensor)
        assert found.tolist() == [1, 2]


@pytest.mark.parametrize(
    "member", [("x/constants.pkl", b""), ("x/byteorder", b"big"), ("y/other", b""), ("x/version", None)]
)
def test_archives_of_another_kind_are_refused(tmp_path, member):
    members = [("x/data.pkl", storage_pickle()), ("x/data/0", struct.pack("<2f", 1, 2))]
    path = archive_of(tmp_path / "a.pt", [*members, member] if member[1] is not None else members[1:])
    with pytest.raises(torch_file.PICKLE_ERRORS):
        torch_file.load(path)


def test_a_damaged_pickle_is_refused(tmp_path):
    path = archive_of(tmp_path / "a.pt", [("x/data.pkl", storage_pickle()), ("x/data/0", bytes(8))])
    path.write_bytes(path.read_bytes().replace(b"storage", b"storagf", 1))
    with refused(torch_file.PICKLE_ERRORS, "damaged"):
        torch_file.load(path)


def test_what_torch_loads_is_what_is_loaded(tmp_path):
    """Types, shared and empty storages, views, parameters."""
    base = torch.arange(24.0).reshape(4, 6)
    content = {
        str(dtype): torch.arange(5).to(dtype)
        for dtype in (torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool)
    }
    content |= {"base": base, "column": base[:, 2], "turned": base.T, "none": torch.zeros(0, 3), "one": torch.tensor(3)}
    torch.save({"content": content, "list": [1, "ä", None, (2.5,)]}, tmp_path / "a.pt")
    found, expected = torch_file.load(tmp_path / "a.pt"), torch.load(tmp_path / "a.pt", weights_only=True)
    assert isinstance(found, dict)
    assert found["list"] == expected["list"]
    for name, value in expected["content"].items():
        ours = found["content"][name]
        assert (ours.dtype, ours.shape, ours.stride()) == (value.dtype, value.shape, value.stride())
        assert torch.equal(ours, value)
    found["content"]["base"][:, 2] = -1
    assert (found["content"]["column"] == -1).all()
    assert torch.equal(torch.load(tmp_path / "a.pt", weights_only=True)["content"]["base"], base)


def test_the_public_loader_gets_the_checked_members_alone(tmp_path, monkeypatch, unpickler):
    """Never anything weaker than weights_only, and no byte of the file that was not checked."""
    torch.save(SAVED, tmp_path / "a.pt")
    calls, load = [], torch.load

    def noted(file, **options):
        calls.append((file, options))
        return load(file, **options)

    monkeypatch.setattr(torch, "load", noted)
    assert torch.equal(torch_file.load(tmp_path / "a.pt")["b"], SAVED["b"])
    if unpickler == "private":
        assert not calls
        return
    ((file, options),) = calls
    assert isinstance(file, io.BytesIO)
    assert options == {"map_location": "cpu", "weights_only": True}
    with zipfile.ZipFile(file) as archive:
        names = ("data.pkl", "byteorder", "version", "data/0", "data/1")
        assert archive.namelist() == [f"archive/{name}" for name in names]


@pytest.mark.parametrize(
    "other",
    [
        types.SimpleNamespace(),
        types.SimpleNamespace(Unpickler=lambda *_, **__: types.SimpleNamespace()),
        types.SimpleNamespace(Unpickler=lambda file: None),
    ],
    ids=["another name", "another method", "other parameters"],
)
def test_a_private_unpickler_of_another_form_is_not_used(tmp_path, monkeypatch, other):
    monkeypatch.setattr(torch_file, "_weights_only_unpickler", other)
    torch.save(SAVED, tmp_path / "a.pt")
    assert torch.equal(torch_file.load(tmp_path / "a.pt")["b"], SAVED["b"])


def test_without_the_private_module_the_reader_is_imported_and_reads(tmp_path, monkeypatch):
    monkeypatch.delattr(torch, "_weights_only_unpickler")
    monkeypatch.setitem(sys.modules, "torch._weights_only_unpickler", None)
    spec = importlib.util.spec_from_file_location("torch_file_elsewhere", torch_file.__file__)
    again = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(again)
    assert again._weights_only_unpickler is None
    archive_of(tmp_path / "a.pt", [("x/data.pkl", HOSTILE["memory"])])
    with refused(again.PICKLE_ERRORS, "GLOBAL", "builtins.bytearray"):
        again.load(tmp_path / "a.pt")


PERSISTENT_HEAD = b"\x80\x02(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpu"
PERSISTENT = PERSISTENT_HEAD[2:] + b"K\x02t"
ELSEWHERE = {
    "no tuple": b"\x80\x02X\x07\x00\x00\x00storageQ.",
    "a tuple from the memo": b"\x80\x02" + PERSISTENT + b"q\x01Qh\x01Q.",
    "a part that is made": PERSISTENT_HEAD + b"K\x01K\x01\x86tQ.",
    "a part from an unknown place": PERSISTENT_HEAD + b"h\x07tQ.",
    "another length": PERSISTENT_HEAD + b"tQ.",
    "another type": b"\x80\x02(X\x07\x00\x00\x00storagectorch\nfloat32\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x02tQ.",
    "a text": b"\x80\x02Pstorage\n.",
}


@pytest.mark.parametrize("content", ELSEWHERE.values(), ids=ELSEWHERE)
def test_a_storage_that_is_named_in_another_way_is_refused(content, unpickler):
    with pytest.raises(pickle.UnpicklingError):
        list(torch_file._storage_ids(content))


def test_storages_are_named_as_torch_names_them():
    (_, pickled), *_ = members_of({"a": SAVED["a"], "part": SAVED["a"][2:], "b": SAVED["b"].double()})
    assert [(kind, key, count) for _, kind, key, _, count in torch_file._storage_ids(pickled)] == [
        (torch.FloatStorage, "0", 1000),
        (torch.FloatStorage, "0", 1000),
        (torch.DoubleStorage, "1", 6),
    ]


@pytest.mark.parametrize("legacy", [False, True])
def test_a_file_that_is_overwritten_after_the_check_is_not_loaded(tmp_path, monkeypatch, legacy):
    path, other = tmp_path / "a.pt", tmp_path / "b.pt"
    torch.save(SAVED, path, _use_new_zipfile_serialization=not legacy)
    torch.save({"a": torch.zeros(1000), "b": SAVED["b"]}, other, _use_new_zipfile_serialization=not legacy)
    check, size = torch_file._check, path.stat().st_size

    def checked_then_overwritten(source):
        check(source)
        with path.open("r+b") as file:
            file.write(other.read_bytes()[:size])

    monkeypatch.setattr(torch_file, "_check", checked_then_overwritten)
    found = torch_file.load(path)
    assert found["a"].equal(SAVED["a"])
