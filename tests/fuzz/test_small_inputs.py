"""Small files that claim much stay within 500 MB. How long they take is a figure of benchmarks/faults.py."""

from __future__ import annotations

import sys

import pytest

from fuzz.run import LONGEST_SENTENCE, MOST_MEMORY_MB
from fuzz.small_inputs import INPUTS, SMALL_BYTES, measure


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peaks of memory are read from /proc")
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", sorted({one.kind for one in INPUTS.values()}))
def test_small_inputs_take_little_memory_and_are_read_or_rejected_in_a_sentence(kind):
    names = [name for name, one in INPUTS.items() if one.kind == kind]
    measured = measure(names)
    assert list(measured) == names
    for name, one in measured.items():
        assert one.bytes < SMALL_BYTES, name
        assert one.peak_mb < MOST_MEMORY_MB, name
        assert one.is_user_error, (name, one.sentence)
        assert len(one.sentence) <= LONGEST_SENTENCE, name
        assert not (INPUTS[name].is_read and one.sentence), (name, one.sentence)
