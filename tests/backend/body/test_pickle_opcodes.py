"""Pickles that would take memory, time or the C stack of Python's unpickler."""

import pickle
import struct
import time
import tracemalloc

import pytest
from primdiffusion.body.pickle_opcodes import PickleError, load_pickle
from primdiffusion.body.smpl_pickle import as_array


def find(module: str, name: str) -> type:
    raise AssertionError(f"{module}.{name}")


@pytest.mark.parametrize(
    "data",
    [
        b"Np300000000\nr\x00\x00\x00\x00",
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
        b"b.", b"0.", b"t.", b"R.", b"h\x05.", b"N", b"", b"]Na]b.", b"NNR.",
    ],
)  # fmt: skip
def test_hostile_pickles_end_at_once_within_little_memory(data):
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(PickleError) as raised:
        load_pickle(data, find)
    assert tracemalloc.get_traced_memory()[1] < 2**26
    tracemalloc.stop()
    assert time.process_time() - began < 10
    assert len(str(raised.value)) < 150


def test_a_memo_is_as_large_as_what_is_stored_in_it():
    tracemalloc.start()
    assert load_pickle(b"Np300000000\n.", find) is None
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.parametrize("protocol", range(6))
def test_plain_values_come_back(protocol):
    value = {"a": [1, -2.5, None, True, 2**40], "b": ("x", ()), "c": {}, "ä": "line\nbreak '"}
    assert load_pickle(pickle.dumps(value, protocol), find) == value


def test_lists_that_contain_each_other_often_are_counted_not_unrolled():
    value: list = [1.0]
    for _ in range(30):
        value = [value] * 10
    with pytest.raises(ValueError, match="more than"):
        as_array(value)
