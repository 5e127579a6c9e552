"""Inputs that have found something once are read, or rejected in a sentence."""

from __future__ import annotations

import pytest

from fuzz.corpus import CASES, folder_of, kept
from fuzz.run import ORDINARY, Tried
from fuzz.targets import TARGETS

NAMES = sorted(path.name for path in CASES.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_what_has_found_something_finds_nothing_now(tmp_path, monkeypatch, name):
    target = next(target for target in TARGETS if folder_of(target.name) == name)
    monkeypatch.chdir(tmp_path)
    tried = Tried(target, target.make(tmp_path), None)
    target.read(tried.path)
    for case, content in kept(CASES / name):
        outcome, about = tried.outcome(content)
        assert set(outcome) <= ORDINARY, f"{case.name}: {about}"
