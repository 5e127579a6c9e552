"""Safetensors files: Blender's reader and the backend's, which is the library, accept and reject the same files."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from primdiffusion.files.tensor_file import TensorFile
from primdiffusion.files.tensor_layout import DTYPES, LARGEST_HEADER

from blender_primdiffusion.scene import human_file
from blender_primdiffusion.ui.generate_settings import read_vocabulary

HUMAN = {"format": "primdiffusion.human", "format_version": "1", "architecture": "{}"}


def all_tensors(path: Path):
    file = TensorFile(path)
    return [file.tensor(name) for name in file.names]


READERS = {"extension": human_file.read_tensors, "backend": all_tensors, "vocabulary": read_vocabulary}


def written(path: Path, header: object, data: bytes) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)
    return path


def entry(dtype: str, shape: list[int], begin: int, end: int) -> dict[str, object]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("reader", READERS)
def test_every_type_is_read(tmp_path, reader, dtype):
    size = np.dtype(DTYPES[dtype]).itemsize
    header = {"__metadata__": HUMAN, "b": entry(dtype, [1, 2], size, 3 * size), "a": entry(dtype, [1], 0, size)}
    READERS[reader](written(tmp_path / "a.human", header, bytes(3 * size)))


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "header",
    [
        {"a": entry("U8", [8], 0, 4)},
        {"a": entry("U8", [9], 0, 9)},
        {"a": entry("U8", [4], 0, 4)},
        {"a": entry("U8", [4], 4, 8)},
        {"a": entry("U8", [8], 0, 8), "b": entry("U8", [8], 0, 8)},
        {"a": entry("U8", [6], 0, 6), "b": entry("U8", [4], 4, 8)},
        {"a": entry("F8_E4M3", [8], 0, 8)},
        {"a": entry("C64", [1], 0, 8)},
        {"a": entry("F33", [2], 0, 8)},
        {"a": entry("U8", [1] * 200_000, 0, 8)},
        {"a": entry("U8", [2**62, 2**62], 0, 8)},
        {"a": entry("U8", [-8], 0, 8)},
        {"a": entry("U8", [8.0], 0, 8)},
        {"a": entry("U8", [8], 0, 2**63)},
        {"a": {"dtype": "U8", "shape": [8]}},
        {"a": None},
        {"__metadata__": {"a": 1}},
        [], b"{", b"\xff", b"[" * 9000, b" " * (LARGEST_HEADER + 1),
    ],
)  # fmt: skip
def test_a_hostile_header_is_one_short_reason(tmp_path, header, reader):
    if isinstance(header, dict):
        header = {"__metadata__": HUMAN, **header}
    with pytest.raises(ValueError, match=r"^.{1,300}$"):
        READERS[reader](written(tmp_path / "a.human", header, bytes(8)))


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("content", [b"", b"\x00", bytes(8), b"\xff" * 8])
def test_a_file_without_a_header_is_rejected(tmp_path, reader, content):
    (tmp_path / "a.human").write_bytes(content)
    with pytest.raises(ValueError, match=r"^.{1,300}$"):
        READERS[reader](tmp_path / "a.human")


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
    sizes = human_file.read_sizes(path)
    for values in (sizes.delta_scale, sizes.betas, sizes.rest_half_extent):
        assert values is not None
        assert values.base is None


def test_tensors_of_a_file_can_be_written_to_and_the_file_stays(tmp_path):
    path = written(tmp_path / "a.safetensors", {"a": entry("U8", [1], 0, 1), "b": entry("F32", [2], 1, 9)}, bytes(9))
    file = TensorFile(path)
    for name in ("a", "b"):
        file.tensor(name).add_(1)
    assert path.read_bytes().endswith(bytes(9))
