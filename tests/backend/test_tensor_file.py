"""Safetensors files whose bytes depend on their content alone."""

import subprocess
import sys

import pytest
import safetensors.torch
import torch
from primdiffusion.tensor_file import save
from safetensors import safe_open

TENSORS = {"b": torch.arange(6.0).reshape(2, 3), "a": torch.ones(3, dtype=torch.float16), "ä": torch.zeros(0)}
METADATA = {name: f"{name} ä" for name in ["the", "quick", "brown", "fox", "jumps", "over", "a", "lazy", "dog"]}
CODE = """
import hashlib, torch
from primdiffusion.tensor_file import save
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
    with pytest.raises(ValueError, match="contiguous"):
        save({"x": torch.ones(3, 4).T})
