"""Safetensors files whose bytes depend on their content alone."""

import os
import subprocess
import sys

import pytest
import safetensors.torch
import torch
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.tensor_file import LARGEST_FILE, ParameterLimit, load_network, read, save
from safetensors import safe_open
from support.errors import refused
from torch import nn

TENSORS = {"b": torch.arange(6.0).reshape(2, 3), "a": torch.ones(3, dtype=torch.float16), "ä": torch.zeros(0)}
METADATA = {name: f"{name} ä" for name in ["the", "quick", "brown", "fox", "jumps", "over", "a", "lazy", "dog"]}
CODE = """
import hashlib, torch
from primdiffusion.files.tensor_file import save
print(hashlib.sha256(save({"x": torch.ones(3), "y": torch.ones(2)}, {str(n): str(n) for n in range(20)})).hexdigest())
"""


def test_another_reader_finds_what_was_saved(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(save(TENSORS, METADATA))
    with safe_open(path, "pt") as file:
        assert file.metadata() == METADATA
    found = safetensors.torch.load_file(path)
    assert found.keys() == TENSORS.keys()
    assert all(torch.equal(found[name], value) and found[name].dtype == value.dtype for name, value in TENSORS.items())


def test_processes_write_the_same_bytes():
    """The order of a hash map differs from process to process, and within one."""
    assert save(TENSORS, METADATA) == save(dict(reversed(TENSORS.items())), dict(reversed(METADATA.items())))
    runs = {subprocess.run([sys.executable, "-c", CODE], capture_output=True, check=True).stdout for _ in range(2)}
    assert len(runs) == 1


def test_without_metadata_only_the_order_can_differ_from_safetensors():
    assert len(save(TENSORS)) == len(safetensors.torch.save(TENSORS))


def test_a_view_is_refused():
    with refused(ValueError, "contiguous"):
        save({"x": torch.ones(3, 4).T})


def test_what_was_saved_is_read(tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(save(TENSORS, METADATA))
    tensors, metadata = read(path)
    assert metadata == METADATA
    assert all(torch.equal(tensors[name], value) for name, value in TENSORS.items())


def test_only_regular_files_of_a_limited_size_are_opened(tmp_path):
    path = tmp_path / "a.safetensors"
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    with refused(FileError, "a.safetensors"):
        read(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(PermissionError):
        read(path)


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
