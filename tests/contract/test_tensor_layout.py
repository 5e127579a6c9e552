"""Safetensors files: both programs accept what the safetensors library accepts, within their limits."""

from __future__ import annotations

import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from fuzz.verdicts import HUMAN, compare, verdicts
from primdiffusion import tensor_file
from primdiffusion.formats import tensor_layout
from primdiffusion.formats.tensor_layout import DTYPES, LARGEST_HEADER, MOST_DIMENSIONS, parse_layout

from blender_primdiffusion.scene import human_file
from blender_primdiffusion.ui.attributes import read_vocabulary

READERS = {"extension": human_file.read_tensors, "backend": tensor_file.opened, "vocabulary": read_vocabulary}


FILES = 2500
"""Each weaker rule below shows within 900; `python -m tests.fuzz --verdicts` compares 10,000."""


def test_damaged_files_get_the_librarys_verdict():
    figures = compare(FILES)
    assert figures["reader_verdicts_compared"] == FILES
    assert figures["reader_verdicts_differ"] == 0
    assert figures["reader_verdicts_accepted"] > FILES / 4


@pytest.mark.parametrize(
    ("module", "rule", "weaker"),
    [
        ("tensor_layout", "_check_cover", lambda *_: None),
        (
            "tensor_layout",
            "_are_sizes",
            lambda sizes: type(sizes) is list and all(isinstance(v, int) for v in sizes),
        ),
        ("tensor_layout", "_DEEPEST", 64),
        ("tensor_layout", "_WORD", 2**70),
        ("tensor_layout", "_BITS", {name: np.dtype(dtype).itemsize * 8 for name, dtype in DTYPES.items()}),
        ("json_files", "_check_strings", lambda _: None),
        ("json_files", "_constant", float),
    ],
)
def test_another_rule_is_another_verdict(monkeypatch, module, rule, weaker):
    for package in ("primdiffusion", "blender_primdiffusion"):
        monkeypatch.setattr(f"{package}.formats.{module}.{rule}", weaker)
    assert any(reason for _, _, reason in verdicts(FILES))


def written(path: Path, header: object, data: bytes) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)
    return path


def entry(dtype: str, shape: list[int], begin: int, end: int) -> dict[str, object]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("size", [740_000, 8_400_000])
def test_tensors_on_the_same_bytes_are_rejected_without_copies_of_them(tmp_path, reader, size):
    count = 8000
    stored = size - 100 * count // 2
    header = {"__metadata__": {**HUMAN, "architecture": "{}"}}
    header |= {str(number): entry("U8", [stored], 0, stored) for number in range(count)}
    path = written(tmp_path / "a.human", header, bytes(stored))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"^.{1,300}$"):
            READERS[reader](path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < path.stat().st_size + 30e6  # of which the tree of the header takes most


def test_what_is_read_are_views_of_one_buffer(tmp_path):
    data = np.arange(4_000_000, dtype="<f4")
    header = {"__metadata__": HUMAN, "rgb": entry("F32", [1000, 4000], 0, data.nbytes)}
    path = written(tmp_path / "a.human", header, data.tobytes())
    tracemalloc.start()
    dtype, shape, raw = human_file.read_tensors(path).arrays["rgb"]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.1 * data.nbytes
    assert np.array_equal(np.frombuffer(raw, DTYPES[dtype]).reshape(shape), data.reshape(1000, 4000))


def test_sizes_that_are_kept_do_not_keep_the_file(tmp_path):
    parts = {
        "rgb": [8, 3, 8, 8, 8], "density": [8, 8, 8, 8], "delta_scale": [8, 3], "betas": [10],
        "rest_half_extent": [8, 3],
    }  # fmt: skip
    header: dict[str, object] = {"__metadata__": HUMAN}
    start = 0
    for name, shape in parts.items():
        header[name] = entry("F32", shape, start, start := start + 4 * int(np.prod(shape)))
    path = written(tmp_path / "a.human", header, np.ones(start // 4, "<f4").tobytes())
    sizes = human_file.read_sizes(human_file.file_version(path))
    for values in (sizes.delta_scale, sizes.betas, sizes.rest_half_extent):
        assert values is not None
        assert values.base is None


@pytest.mark.parametrize(
    "header",
    [
        b'{"a":{"dtype":"U8","shape":[8],"data_offsets":[0,8]},"a":{"dtype":"U8","shape":[8],"data_offsets":[0,8]}}',
        b'{"__metadata__":{"x":"1","x":"2"},"a":{"dtype":"U8","shape":[8],"data_offsets":[0,8]}}',
        {"a": entry("F8_E4M3", [8], 0, 8)},
        {"a": entry("C64", [1], 0, 8)},
        {"a": entry("U8", [8] + [1] * MOST_DIMENSIONS, 0, 8)},
        {"a": entry("U8", [8], 0, 8), "b": entry("U8", [0, 2**63], 8, 8)},
        b'{"a":{"dtype":"U8","shape":[8],"data_offsets":[0,8]}}' + b" " * LARGEST_HEADER,
    ],
    ids=["tensor twice", "metadata twice", "float8", "complex", "axes", "side", "header"],
)
def test_what_the_format_permits_and_the_programs_do_not_read_is_rejected_by_both(tmp_path, header):
    path = written(tmp_path / "a.human", header, bytes(8))
    content = path.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    parse_layout(content[8:end], 8)
    for read in READERS.values():
        with pytest.raises(ValueError, match=r"^.{1,300}$"):
            read(path)
    with pytest.raises(ValueError), path.open("rb") as file:
        tensor_layout.check_limits(tensor_layout.read_layout(file))


def test_a_file_that_takes_the_name_of_another_is_not_read(tmp_path, monkeypatch):
    """The checked file is replaced after its header was read: its own numbers are found."""
    path = written(tmp_path / "a.safetensors", {"a": entry("F32", [2], 0, 8)}, np.array([1, 2], "<f4").tobytes())
    other = written(tmp_path / "b.safetensors", {"a": entry("F32", [2], 0, 8)}, np.array([8, 9], "<f4").tobytes())
    check = tensor_layout.check_limits

    def checked_then_replaced(layout):
        check(layout)
        os.replace(other, path)

    monkeypatch.setattr(tensor_file, "check_limits", checked_then_replaced)
    tensors, _ = tensor_file.read(path)
    assert tensors["a"].tolist() == [1, 2]


def test_tensors_of_a_file_can_be_written_to_and_the_file_stays(tmp_path):
    path = written(tmp_path / "a.safetensors", {"a": entry("U8", [1], 0, 1), "b": entry("F32", [2], 1, 9)}, bytes(9))
    file = tensor_file.opened(path)
    for name in ("a", "b"):
        file.tensor(name).add_(1)
    assert file.tensor("b").data_ptr() % 4 == 0
    assert path.read_bytes().endswith(bytes(9))
