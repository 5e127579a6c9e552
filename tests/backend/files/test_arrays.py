"""The reader of arrays on damaged and hostile files."""

import os
import struct
import warnings
import zipfile

import numpy as np
import pytest
from primdiffusion.files.arrays import (
    all_finite,
    array_shape,
    read_arrays,
    read_npy,
    read_numbers,
    write_deflated,
)
from primdiffusion.files.regular_files import FileError
from support.errors import refused


def npy(descr: str = "'<f4'", shape: str = "(3,)", data: bytes = b"") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def npz(path, member: bytes, method: int = zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("pose.npy", member)
    return path


def assert_one_sentence(error: Exception, path) -> None:
    assert str(path) in str(error)
    assert len(str(error)) - len(str(path)) < 250
    assert "\n" not in str(error)


@pytest.mark.parametrize(
    "member",
    [
        b"hello",
        b"\x93NUMPY\x01\x00\x20\x00{'descr': '<f4', (",
        b"\x93NUMPY\x01\x00\x88\x13" + b"(" * 5000,
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff",
        npy(shape="(-3, -1)", data=bytes(12)),
        npy(shape="'a'"),
        npy(shape=f"({'9' * 400},)"),
        npy(shape="(1000000000000,)"),
        npy("'V0'", "(1000000000000,)"),
        npy("'<f99'"),
        npy("'|O'"),
        npy(shape="(3,)", data=bytes(11)),
        npy(shape="(True,)", data=bytes(4)),
        npy(shape="(1.0,)", data=bytes(4)),
        npy(shape="[1]", data=bytes(4)),
        npy("'<c16'", data=bytes(48)),
        npy("'<M8[s]'", data=bytes(24)),
        npy("[('a', '<f4')]", data=bytes(12)),
        npy("'<U1000000000'", "()", bytes(4)),
    ],
)
def test_a_member_that_is_no_array_is_one_sentence(tmp_path, member):
    path = npz(tmp_path / "poses.npz", member)
    with pytest.raises(FileError) as raised:
        read_arrays(path, ("pose",))
    assert_one_sentence(raised.value, path)


def test_arrays_of_one_call_share_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr("primdiffusion.files.arrays.LARGEST_BYTES", 1000)
    path = tmp_path / "two.npz"
    np.savez(path, a=np.zeros(100), b=np.zeros(100, np.uint8))
    with refused(FileError):
        read_arrays(path, ("a", "b"))
    assert len(read_arrays(path, ("b",))["b"]) == 100


@pytest.mark.parametrize(
    ("values", "why"),
    [
        *((np.array([0.0, value]), "NaN") for value in (np.nan, np.inf, 1e39)),
        (np.array([-(2**63)]), "NaN"),
        (np.array(["a"]), "not numbers"),
        (np.array([object()]), "pickled"),
    ],
)
def test_numbers_fit_float32(tmp_path, values, why):
    np.savez(tmp_path / "a.npz", uv=values)
    with refused(FileError, why):
        read_numbers(tmp_path / "a.npz", ("uv",))


def test_an_array_that_is_not_there_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", y=np.zeros(2))
    with refused(FileError, "'x'"):
        read_numbers(tmp_path / "a.npz", ("x",))


def test_what_is_written_is_read(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3).T, "b": np.array("text"), "c": np.zeros((0, 3), np.uint8)}
    write_deflated(tmp_path / "a.npz", arrays)
    found = read_arrays(tmp_path / "a.npz", tuple(arrays))
    assert all(np.array_equal(found[name], values) for name, values in arrays.items())
    assert array_shape(tmp_path / "a.npz", "a") == (3, 2)


def test_numbers_of_half_precision_are_checked_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all_finite(np.float16([-65504, 1]))
        assert not all_finite(np.float16([1, np.inf]))
        assert not all_finite(np.float32([1e31]))


def test_headers_of_python_2_are_read_without_a_warning(tmp_path, recwarn):
    head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1L,), }".ljust(117) + b"\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(4))
    assert read_npy(tmp_path / "a.npy").shape == (1,)
    assert not recwarn


@pytest.mark.parametrize(("offset", "value"), [(8, 99), (8, 12), (6, 1)], ids=["unknown", "bzip2", "encrypted"])
def test_members_packed_in_another_way_are_rejected(tmp_path, offset, value):
    path = npz(tmp_path / "poses.npz", npy(data=bytes(12)))
    data = bytearray(path.read_bytes())
    for mark, further in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):  # the member's two headers
        place = data.find(mark) + offset + further
        data[place : place + 2] = struct.pack("<H", value)
    path.write_bytes(data)
    with pytest.raises(FileError) as raised:
        read_arrays(path, ("pose",))
    assert_one_sentence(raised.value, path)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_a_full_disk_is_one_error():
    with refused(OSError, "space") as raised:
        write_deflated("/dev/full", {"a": np.random.default_rng(0).random(100_000)})
    assert raised.value.__context__ is None or isinstance(raised.value.__context__, (OSError, ValueError))
