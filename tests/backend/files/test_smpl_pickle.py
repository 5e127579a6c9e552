"""Pickles that would take memory, time or C stack of Python's unpickler, or change the reader's own classes."""

import pickle
import struct
import time
import tracemalloc

import pytest
from primdiffusion.files import smpl_pickle
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.smpl_pickle import as_array, load_restricted


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
        b"b.", b"0.", b"t.", b"R.", b"h\x05.", b"N", b"", b"NNR.",
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
    assert len(str(raised.value)) < 150


@pytest.mark.parametrize("protocol", range(6))
def test_plain_values_come_back(protocol):
    value = {"a": [1, -2.5, None, True, 2**40], "b": ("x", ()), "c": {}, "ä": "line\nbreak '"}
    assert load_restricted(pickle.dumps(value, protocol), "a.pkl") == value


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
        assert type(found) is smpl_pickle.Inert
    assert before == {kind: dict(vars(kind)) for kind in before}


def test_lists_that_contain_each_other_often_are_counted_not_unrolled():
    value: list = [1.0]
    for _ in range(30):
        value = [value] * 10
    with pytest.raises(ValueError, match="more than"):
        as_array(value)
