"""Inputs that have found something are kept small, and are read now, or rejected in a sentence."""

from __future__ import annotations

import pytest

from fuzz.findings import CASES, folder_of, keep, kept, shrunk
from fuzz.run import ORDINARY, Tried
from fuzz.targets import TARGETS

NAMES = sorted(path.name for path in CASES.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_what_has_found_something_finds_nothing_now(tmp_path, monkeypatch, name):
    target = next(target for target in TARGETS if folder_of(target.name) == name)
    monkeypatch.chdir(tmp_path)
    tried = Tried(target, target.make(tmp_path))
    target.read(tried.path)
    for case, content in kept(CASES / name):
        outcome, about = tried.outcome(content)
        assert set(outcome) <= ORDINARY, f"{case.name}: {about}"


def test_a_large_case_is_packed(tmp_path):
    path = keep(tmp_path, bytes(10**6), ".human")
    assert path.name.endswith(".human.xz")
    assert path.stat().st_size < 1000
    assert [content for _, content in kept(tmp_path)] == [bytes(10**6)]


def test_a_finding_is_shrunk_to_what_it_needs():
    assert shrunk(b"x" * 50 + b"HIT" + b"y" * 40, lambda content: b"HIT" in content) == b"HIT"
