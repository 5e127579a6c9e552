"""Inputs that reach new lines are kept, and others are made from them and from two of them."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fuzz import corpus
from fuzz.combinations import combined
from fuzz.corpus import Corpus, keep, kept, shrunk
from fuzz.coverage import Coverage
from fuzz.run import Tried, damaged
from fuzz.target import Target


def make(folder: Path) -> Path:
    (folder / "a.bin").write_bytes(bytes(6))
    return folder / "a.bin"


def one_byte(content: bytes, rng: np.random.Generator) -> bytes:
    place = int(rng.integers(len(content)))
    return content[:place] + bytes([int(rng.integers(8))]) + content[place + 1 :]


def read(path: Path) -> None:
    content = path.read_bytes().ljust(3)
    if content[0] != 7:
        raise ValueError(f"{path} does not begin")
    if content[1] != 6:
        raise ValueError(f"{path} goes on otherwise")
    if content[2] != 5:
        raise ValueError(f"{path} ends otherwise")
    raise KeyError("a defect behind three steps")


TARGET = Target("steps", make, (one_byte,), read)
COUNT = 2000


def test_a_defect_behind_three_steps_is_found_by_learning_alone(tmp_path):
    tried = Tried(TARGET, make(tmp_path), None)
    coverage = Coverage((__file__,))
    outcomes = (tried.learn(tried.next_input(0, number), coverage)[0] for number in range(COUNT))
    assert ["tracebacks"] in outcomes
    assert [content[:2] for content in tried.corpus.contents[-2:]] == [b"\7\0", b"\7\6"]
    assert not any(damaged(TARGET, bytes(6), 0, number)[:3] == b"\7\6\5" for number in range(COUNT))


def test_lines_of_other_files_are_no_news(tmp_path):
    coverage = Coverage((str(tmp_path),))
    with coverage:
        json.loads("[1]")
    assert not coverage.has_news
    assert coverage.new_lines() == []


def test_what_was_learned_is_tried_first_in_the_next_run_and_forgotten_if_it_is_not_new(tmp_path):
    first = Corpus(b"valid", tmp_path)
    first.learn(b"one")
    first.learn(b"two" * 10_000)
    second = Corpus(b"valid", tmp_path)
    waiting = [second.waiting(), second.waiting()]
    assert sorted(waiting, key=len) == [b"one", b"two" * 10_000]
    assert second.waiting() is None
    second.learn(b"one")
    assert [content for _, content in kept(tmp_path)] == [b"one"]


def test_no_more_is_learned_than_there_is_room_for(monkeypatch):
    monkeypatch.setattr(corpus, "ROOM", 5)
    learned = Corpus(b"valid")
    for content in (b"four", b"two", b"1"):
        learned.learn(content)
    assert learned.contents == [b"valid", b"four", b"1"]


def test_a_large_case_is_packed(tmp_path):
    path = keep(tmp_path, bytes(10**6), ".human")
    assert path.name.endswith(".human.xz")
    assert path.stat().st_size < 1000
    assert [content for _, content in kept(tmp_path)] == [bytes(10**6)]


def test_a_finding_is_shrunk_to_what_it_needs():
    assert shrunk(b"x" * 50 + b"HIT" + b"y" * 40, lambda content: b"HIT" in content) == b"HIT"


def archive(**members: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    return out.getvalue()


def tensors(name: str, data: bytes) -> bytes:
    header = {"__metadata__": {"of": name}, name: {"dtype": "U8", "shape": [2], "data_offsets": [0, len(data)]}}
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def glb(text: bytes, data: bytes) -> bytes:
    parts = ((b"JSON", text), (b"BIN\0", data))
    body = b"".join(len(content).to_bytes(4, "little") + kind + content for kind, content in parts)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


@pytest.mark.parametrize(
    ("first", "second", "wanted"),
    [
        (archive(a=b"first"), archive(a=b"other"), (b"first", b"other")),
        (tensors("a", b"AA"), tensors("b", b"BB"), (b'"a"', b'"b"', b"AABB")),
        (tensors("a", b"AA"), tensors("b", b"BB"), (b'"of": "b"', b'"a"', b"AA")),
        (glb(b"{1}", b"AAAA"), glb(b"{2}", b"BBBB"), (b"{1}", b"BBBB")),
        (b'{"a": [1]}', b'{"b": [22]}', (b'"a"', b"22")),
    ],
    ids=["two members", "two headers", "other metadata", "two chunks", "two trees"],
)
def test_two_inputs_become_one(first, second, wanted):
    made = [combined(first, second, np.random.default_rng(seed)) for seed in range(200)]
    assert any(all(part in content for part in wanted) for content in made)
    assert len(set(made)) > 20
