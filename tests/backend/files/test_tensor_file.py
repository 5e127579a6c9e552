"""Safetensors files whose bytes depend on their content alone."""

import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile

import pytest
import safetensors.torch
import torch
from primdiffusion.files import smpl_pickle, torch_file
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.smpl_pickle import as_array, load_restricted
from primdiffusion.files.tensor_file import ParameterLimit, load_network, read, save
from safetensors import safe_open
from support.errors import refused
from torch import nn

TENSORS = {"b": torch.arange(6.0).reshape(2, 3), "a": torch.ones(3, dtype=torch.float16), "ä": torch.zeros(0)}
METADATA = {name: f"{name} ä" for name in ["the", "quick", "brown", "fox", "jumps", "over", "a", "lazy", "dog"]}
CODE = """
import sys, torch
from primdiffusion.files.tensor_file import save
sys.stdout.buffer.write(save({"x": torch.ones(3), "y": torch.ones(2)}, {str(n): str(n) for n in range(20)}))
"""


def test_another_reader_finds_what_was_saved(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(save(TENSORS, METADATA))
    with safe_open(path, "pt") as file:
        assert file.metadata() == METADATA
    found = safetensors.torch.load_file(path)
    assert found.keys() == TENSORS.keys()
    assert all(torch.equal(found[name], value) and found[name].dtype == value.dtype for name, value in TENSORS.items())
    tensors, metadata = read(path)
    assert metadata == METADATA
    assert all(torch.equal(tensors[name], value) for name, value in TENSORS.items())


def test_processes_write_the_same_bytes():
    """The order of a hash map differs from process to process, and within one."""
    assert save(TENSORS, METADATA) == save(dict(reversed(TENSORS.items())), dict(reversed(METADATA.items())))
    other = subprocess.run([sys.executable, "-c", CODE], capture_output=True, check=True).stdout
    assert other == save({"x": torch.ones(3), "y": torch.ones(2)}, {str(n): str(n) for n in range(20)})


def test_a_view_is_refused():
    with refused(ValueError, "contiguous"):
        save({"x": torch.ones(3, 4).T})


def test_a_file_that_was_read_may_be_overwritten(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(save({"a": torch.arange(100_000.0)}))
    tensors, _ = read(path)
    path.write_bytes(b"another one")
    assert torch.equal(tensors["a"], torch.arange(100_000.0))


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e30])
def test_numbers_that_nothing_can_compute_with_are_named(tmp_path, number):
    path = tmp_path / "a.safetensors"
    path.write_bytes(save({"fine": torch.ones(2), "faulty": torch.tensor([0, number])}))
    with refused(ValueError, "'faulty'"):
        read(path)


def test_a_network_gets_the_weights_of_a_file():
    weights = {"weight": torch.ones(2, 3), "bias": torch.zeros(2)}
    network = load_network(lambda: nn.Linear(3, 2), weights)
    assert torch.equal(network(torch.ones(1, 3)), torch.full((1, 2), 3.0))
    with refused(RuntimeError, "bias"):
        load_network(lambda: nn.Linear(3, 2), {"weight": torch.ones(2, 3)})


@pytest.mark.parametrize(
    "build",
    [
        lambda: nn.Linear(10**12, 10**5),
        lambda: nn.Parameter(torch.randn(size=(10**6, 10**6))),
        lambda: torch.full((10**6, 10**6), 1.0),
        lambda: nn.ModuleList(nn.Conv2d(8, 8, 3) for _ in range(10**12)),
    ],
)
def test_what_is_larger_than_the_file_gets_no_memory(build):
    with refused(RuntimeError, "parameters"), ParameterLimit({"a": torch.zeros(10)}):
        build()


@pytest.mark.parametrize("legacy", [False, True])
def test_tensors_are_read(tmp_path, legacy):
    content = {"a": torch.arange(6.0).reshape(2, 3).half(), "b": torch.nn.Parameter(torch.ones(3)), "n": {"step": 3}}
    torch.save(content, tmp_path / "a.pt", _use_new_zipfile_serialization=not legacy)
    found = torch_file.load(tmp_path / "a.pt")
    assert isinstance(found, dict)
    assert torch.equal(found["a"], content["a"])
    assert torch.equal(found["b"], content["b"])
    assert found["n"] == {"step": 3}


def test_the_sentence_names_what_a_pickle_would_have_run(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        archive.writestr("a/data.pkl", b"cos\nsystem\n(S'touch CANARY'\ntR.")
        archive.writestr("a/version", b"3")
    with refused(FileError, "os.system", "nothing was executed"):
        torch_file.load(tmp_path / "a.pt")


def test_writing_to_what_was_loaded_leaves_the_file_as_it_is(tmp_path):
    torch.save({"a": torch.arange(6.0)}, tmp_path / "a.pt")
    content = (tmp_path / "a.pt").read_bytes()
    found = torch_file.load(tmp_path / "a.pt")
    assert isinstance(found, dict)
    found["a"][:] = -1
    assert (tmp_path / "a.pt").read_bytes() == content


@pytest.mark.parametrize(
    "data",
    [
        b"\x8b" + struct.pack("<i", 2**31 - 1) + b"1.",
        b"\x8b" + struct.pack("<i", -5) + b"1.",
        b"\x8e" + struct.pack("<Q", 2**62) + b"1.",
        b"\x80\x05\x96" + struct.pack("<Q", 2**33) + b"1.",
        b"L" + b"9" * 200_000 + b"L\n.",
        b"(" + b"]" * 2_000_000 + b"l.",
        b"N" + b"\x85" * 2_000_000 + b".",
        b"}N" + b"\x85" * 200_000 + b"Ns.",
        b"Phello\n.",
        b"\x82\x01.",
        b"\x80\x09N.",
        b"b.", b"0.", b"t.", b"R.", b"h\x05.", b"N", b"", b"NNR.", b"X\x01", b"\x80\x04\x95\x01",
    ],
)  # fmt: skip
def test_hostile_pickles_end_at_once_within_little_memory(data):
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(FileError) as raised:
        load_restricted(data, "a.pkl")
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()
    assert time.process_time() - began < 10
    assert len(str(raised.value)) < 200


@pytest.mark.parametrize("data", [b"Np300000000\n.", b"Nr\xff\xff\xff\x7f."])
def test_a_value_remembered_under_a_large_number_takes_no_memory(data):
    tracemalloc.start()
    assert load_restricted(data, "a.pkl") is None
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_strings_of_python_2_are_latin1_and_as_long_as_their_line():
    data = b"(lp1\nS'\\x80\\xff" + b"x" * 2_000_000 + b"'\np2\naU\x01\xe9a."
    first, second = load_restricted(data, "a.pkl")
    assert (first[:3], len(first), second) == ("\x80\xffx", 2_000_002, "\xe9")


@pytest.mark.parametrize(
    "data",
    [
        b"cnumpy\nndarray\nN}S'arguments'\nNs\x86b.",
        b"ccopyreg\n_reconstructor\nN}S'__new__'\nNs\x86b.",
        b"ccopyreg\n_reconstructor\n}S'__new__'\nNsb.",
        b"\x80\x02cnumpy\nndarray\n)\x81N}S'__class__'\nNs\x86b.",
    ],
)
def test_a_state_changes_neither_classes_nor_what_an_object_is(data):
    before = {kind: dict(vars(kind)) for kind in vars(smpl_pickle).values() if isinstance(kind, type)}
    try:
        found = load_restricted(data, "a.pkl")
    except FileError:
        pass
    else:
        assert isinstance(found, smpl_pickle.Stored)
    assert before == {kind: dict(vars(kind)) for kind in before}


def test_lists_that_contain_each_other_often_are_counted_not_unrolled():
    value: list = [1.0]
    for _ in range(30):
        value = [value] * 10
    with refused(ValueError, "more than"):
        as_array(value)
