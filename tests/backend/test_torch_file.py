"""Files of torch.save: tensors are read, constructors that take memory are not called."""

import pickle
import struct
import zipfile

import pytest
import torch
from primdiffusion import torch_file

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
    found = torch_file.load(tmp_path / "a.pt", mapped=True)
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
    with pytest.raises(ValueError, match="compressed"):
        torch_file.load(tmp_path / "b.pt")
