"""A short form of `make fuzz`: some damaged inputs of every kind."""

from __future__ import annotations

import json

import numpy as np
import pytest
from primdiffusion.serve.server import REQUESTS

from fuzz.mutations import JSON, as_json
from fuzz.run import damaged, run
from fuzz.served import CALLS
from fuzz.targets import TARGETS


def test_damaged_files_end_in_a_sentence_or_are_read():
    inputs = len(TARGETS)
    report = run(seed=1, inputs=inputs)
    assert report.findings == []
    assert report.counts["inputs"] == inputs
    assert report.counts["sentences"] > inputs / 4


def test_every_request_of_the_child_is_damaged():
    assert set(CALLS) == {*REQUESTS, "hello", "cancel", "shutdown"}


def test_a_seed_gives_the_same_damage():
    content = json.dumps({"pose": [[0.1] * 3] * 24, "translation": [0, 1, 2]}).encode()
    target = next(target for target in TARGETS if target.mutations == JSON)
    made = [damaged(target, content, 5, number) for number in range(30)]
    assert made == [damaged(target, content, 5, number) for number in range(30)]
    assert len(set(made)) > 20


@pytest.mark.parametrize("content", [b"[]", b"3", b'{"a": {}}'])
def test_small_json_can_be_damaged_too(content):
    rng = np.random.default_rng(0)
    assert all(isinstance(as_json(content, rng), bytes) for _ in range(50))
