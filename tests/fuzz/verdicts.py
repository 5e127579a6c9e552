"""Whether the program's readers of safetensors files accept what the library accepts: ten thousand damaged files.

`python -m tests.fuzz --verdicts` prints the figures. Each file goes to the safetensors library and to
`formats.tensor_layout` without the programs' limits: both must accept or reject it, and find the same tensors and
metadata. It also goes to the extension's and to the backend's reader, which must accept it where the library does, the
limits of `check_limits` hold and, in the extension, the metadata name a human.
"""

from __future__ import annotations

import collections
import dataclasses
import io
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch
from numpy.random import Generator
from primdiffusion import tensor_file
from primdiffusion.formats.json_files import Pairs
from primdiffusion.formats.tensor_layout import DTYPES, LONGEST_HEADER, TensorLayout, check_limits, read_layout

from blender_primdiffusion.scene.human_file import HumanTensors, read_tensors
from fuzz import mutations
from fuzz.mutations import pick

COUNT = 10_000
BITS = {
    "BOOL": 8, "F4": 4, "F6_E2M3": 6, "F6_E3M2": 6, "U8": 8, "I8": 8, "F8_E5M2": 8, "F8_E4M3": 8, "F8_E8M0": 8,
    "F8_E4M3FNUZ": 8, "F8_E5M2FNUZ": 8, "I16": 16, "U16": 16, "F16": 16, "BF16": 16, "I32": 32, "U32": 32, "F32": 32,
    "C64": 64, "F64": 64, "I64": 64, "U64": 64,
}  # fmt: skip
SIZES = (
    "0", "1", "2", "3", " 2 ", "-1", "-0", "0.0", "1.0", "2e0", "02", "+1", "true", "null", '"2"', "[2]", "{}",
    "4294967296", "4611686018427387904", "9223372036854775808", "18446744073709551615", "18446744073709551616",
    "1e400", "NaN", "",
)  # fmt: skip
"""JSON in place of a size or an offset."""
WIDE = (
    "[0,18446744073709551615,2]",
    "[18446744073709551615,0]",
    "[18446744073709551615,2,0]",
    "[4294967296,4294967296,0]",
)
"""Shapes of no values, some of which overflow where sides are multiplied from left to right."""
VALUES = (
    "null", "true", "0", "-0", "1.5", "1e308", "1e309", "-1e999", "1" * 400, "-" + "1" * 25, "NaN", "Infinity",
    "-Infinity", '""', '"F32"', '"\\ud800"', '"\\ude00\\ud83d"', '"\\ud83d\\ude00"', '"\\u0000"', '"\\x"', '"a\tb"',
    '"\x7f"', "'a'", "[]", "[1,]", "{}", '{"a":1,"a":2}', '{"F32":null}', "//", "[" * 124 + "]" * 124,
    "[" * 125 + "]" * 125, "[" * 126 + "]" * 126, "[" * 5000 + "]" * 5000, '{"a":' * 130 + "1" + "}" * 130,
    "[[0,1],[2]]",
)  # fmt: skip
"""JSON, and what is not quite JSON, in place of any value."""
DTYPE_TEXTS = (*(f'"{name}"' for name in BITS), '"f32"', '"F33"', '"F32 "', '{"F32":null}', '{"F32":[]}', "11", "null")
KEYS = (
    '"a"',
    '"b"',
    '""',
    '"\\u0061"',
    '"__metadata__"',
    '"\\u005f_metadata__"',
    '"\\ud800"',
    '"ä"',
    '"a\\/b"',
    "a",
    "1",
)
SPACES = (b"", b" ", b" " * 64, b"\n", b"\t\r\n ", b"\0", b"\xef\xbb\xbf", b"\x0b", b"x", b"{}", b"\xff")
HUMAN = {"format": "primdiffusion.human", "format_version": "1", "provenance": "{}"}


@dataclasses.dataclass
class Draft:
    """A file in parts that can be damaged: JSON texts of names and values, in which a name may occur twice."""

    entries: list[tuple[str, list[tuple[str, str]] | str]]
    """The header: a name, and the fields of a tensor or any other value."""
    data: bytes
    before: bytes = b""
    after: bytes = b""
    """Around the header's object."""
    length_error: int = 0

    def tensors(self) -> list[list[tuple[str, str]]]:
        """The fields of each tensor."""
        return [value for _, value in self.entries if isinstance(value, list)]

    def content(self) -> bytes:
        """The file."""
        parts = (f"{name}:{value if isinstance(value, str) else _object(value)}" for name, value in self.entries)
        header = self.before + ("{" + ",".join(parts) + "}").encode("utf-8", "surrogatepass") + self.after
        return ((len(header) + self.length_error) % 2**64).to_bytes(8, "little") + header + self.data


def drafted(content: bytes) -> Draft:
    """The parts of a file that is not damaged too much. Raises ValueError, TypeError."""
    end = 8 + int.from_bytes(content[:8], "little")
    tree = json.loads(content[8:end], object_pairs_hook=Pairs)

    def fields_of(value: Any) -> list[tuple[str, str]] | str:
        return [(json.dumps(k), _text(v)) for k, v in value] if isinstance(value, Pairs) else _text(value)

    entries = [(json.dumps(name), _text(v) if name == "__metadata__" else fields_of(v)) for name, v in tree]
    return Draft(entries, content[end:])


def _text(value: Any) -> str:
    """The JSON of a value whose objects are Pairs."""
    if isinstance(value, Pairs):
        return _object([(json.dumps(name), _text(inner)) for name, inner in value])
    return "[" + ",".join(map(_text, value)) + "]" if isinstance(value, list) else json.dumps(value)


def _object(fields: list[tuple[str, str]]) -> str:
    return "{" + ",".join(f"{name}:{value}" for name, value in fields) + "}"


def draft(rng: Generator) -> Draft:
    """A valid file of a few small tensors, some of them empty or scalars, of any dtype and at any address."""
    entries: list[tuple[str, list[tuple[str, str]] | str]] = []
    start = 0
    for number in range(int(rng.integers(0, 5))):
        dtype = pick(rng, list(BITS) if rng.random() < 0.3 else ("F32", "F32", "U8", "F16", "BF16", "I64"))
        shape = [int(side) for side in rng.choice([0, 1, 2, 3, 4, 8], int(rng.integers(0, 4)))]
        if (bits := math.prod(shape) * BITS[dtype]) % 8:
            shape, bits = [8, *shape], 8 * bits
        end = start + bits // 8
        fields = [('"dtype"', f'"{dtype}"'), ('"shape"', json.dumps(shape)), ('"data_offsets"', f"[{start},{end}]")]
        entries.append((f'"{"abcdefg"[number]}"', [fields[i] for i in rng.permutation(3)]))
        start = end
    entries = [entries[i] for i in rng.permutation(len(entries))]
    if rng.random() < 0.8:
        entries.insert(int(rng.integers(len(entries) + 1)), ('"__metadata__"', json.dumps(HUMAN)))
    return Draft(entries, rng.integers(0, 2, start, np.uint8).tobytes())


def _field(file: Draft, rng: Generator, name: str, change: Callable[[str], str]) -> None:
    """Change the JSON of a field of one of the tensors."""
    tensors = file.tensors()
    if not tensors:
        return
    fields = pick(rng, tensors)
    for place, (field, text) in enumerate(fields):
        if field == name:
            fields[place] = (field, change(text))


def offsets(file: Draft, rng: Generator) -> None:
    """A place moves, or becomes that of another tensor."""
    texts = [text for fields in file.tensors() for name, text in fields if name == '"data_offsets"']

    def change(text: str) -> str:
        if rng.random() < 0.3:
            return pick(rng, texts)
        parts = text.strip("[]").split(",")
        place = int(rng.integers(len(parts)))
        if rng.random() < 0.5 and parts[place].isdigit():
            parts[place] = str(int(parts[place]) + pick(rng, (-8, -4, -1, 1, 4, 8, 2**62, 2**64 - 8)))
        elif rng.random() < 0.7:
            parts[place] = pick(rng, SIZES)
        else:
            parts = pick(rng, ([], parts[:1], parts[::-1], [*parts, parts[0]]))
        return f"[{','.join(parts)}]"

    _field(file, rng, '"data_offsets"', change)


def shapes(file: Draft, rng: Generator) -> None:
    """A shape has another side, more or fewer of them, or is something else."""

    def change(text: str) -> str:
        sides = [side for side in text.strip("[]").split(",") if side]
        chance = rng.random()
        if chance < 0.4:
            sides.insert(int(rng.integers(len(sides) + 1)), pick(rng, SIZES))
        elif chance < 0.6 and sides:
            sides[int(rng.integers(len(sides)))] = pick(rng, SIZES)
        elif chance < 0.7:
            sides += ["1"] * int(rng.integers(1, 80))
        elif chance < 0.75:
            sides = sides[::-1]
        else:
            return pick(rng, WIDE if chance < 0.9 else VALUES)
        return f"[{','.join(sides)}]"

    _field(file, rng, '"shape"', change)


def dtypes(file: Draft, rng: Generator) -> None:
    """A tensor has another dtype, often of the same size."""
    _field(file, rng, '"dtype"', lambda _: pick(rng, DTYPE_TEXTS))


def fields(file: Draft, rng: Generator) -> None:
    """A field is missing, twice there, unknown, or has any value; or a tensor is a list of its fields."""
    if not (places := [place for place, (_, value) in enumerate(file.entries) if isinstance(value, list)]):
        return
    place = pick(rng, places)
    name, found = file.entries[place]
    chance = rng.random()
    if chance < 0.15:
        del found[int(rng.integers(len(found)))]
    elif chance < 0.3:
        found.insert(int(rng.integers(len(found) + 1)), pick(rng, found))
    elif chance < 0.7:
        found.insert(int(rng.integers(len(found) + 1)), (pick(rng, ('"x"', '"x"', *KEYS)), pick(rng, VALUES)))
    elif chance < 0.8:
        found[int(rng.integers(len(found)))] = (pick(rng, found)[0], pick(rng, VALUES))
    else:
        by_name = dict(found)
        texts = [by_name.get(field, "1") for field in ('"dtype"', '"shape"', '"data_offsets"')]
        texts = pick(rng, (texts, texts, texts[:2], [*texts, "1"]))
        file.entries[place] = (name, f"[{','.join(texts)}]")


def names(file: Draft, rng: Generator) -> None:
    """An entry is there twice, gets another name or value, is missing, or is new."""
    if not file.entries:
        return
    place, new = int(rng.integers(len(file.entries))), int(rng.integers(len(file.entries) + 1))
    name, value = file.entries[place]
    chance = rng.random()
    if chance < 0.2:
        file.entries.insert(new, (name, value))
    elif chance < 0.4:
        file.entries.insert(new, (name, pick(rng, file.entries)[1]))
    elif chance < 0.6:
        file.entries[place] = (pick(rng, KEYS), value)
    elif chance < 0.7:
        del file.entries[place]
    else:
        file.entries.insert(new, (pick(rng, (*KEYS, name)), pick(rng, VALUES)))


def metadata(file: Draft, rng: Generator) -> None:
    """The metadata hold something else than different texts."""
    value = f'{{"format":"primdiffusion.human",{pick(rng, KEYS)}:{pick(rng, VALUES)}}}'
    if rng.random() < 0.3:
        value = pick(rng, ("null", "[]", "{}", '{"format":"other","format":"primdiffusion.human"}', *VALUES))
    file.entries = [entry for entry in file.entries if entry[0] != '"__metadata__"']
    file.entries.insert(int(rng.integers(len(file.entries) + 1)), ('"__metadata__"', value))


def around(file: Draft, rng: Generator) -> None:
    """The header begins or ends with something, or is of another length than stated."""
    chance = rng.random()
    if chance < 0.3:
        file.before = pick(rng, SPACES)
    elif chance < 0.6:
        file.after = pick(rng, SPACES)
    else:
        file.length_error = pick(rng, (-(10**6), -9, -2, -1, 1, 2, 8, 100_000_000, 2**63))


def data(file: Draft, rng: Generator) -> None:
    """There are more or fewer bytes of data."""
    count = pick(rng, (1, 4, 8))
    file.data = file.data + bytes(count) if rng.random() < 0.5 else file.data[:-count]


DRAFT_MUTATIONS = (offsets, offsets, shapes, shapes, dtypes, fields, fields, names, names, metadata, around, data)
BYTE_MUTATIONS = (mutations.flip, mutations.truncate, mutations.splice, mutations.integer)


def damaged_files(count: int, seed: int) -> Iterator[bytes]:
    """The same files for the same seed; of ten, one is valid, and two are damaged as bytes."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        file = draft(rng)
        kind = number % 10
        for _ in range(0 if kind < 3 else int(rng.integers(1, 3))):
            pick(rng, DRAFT_MUTATIONS)(file, rng)
        content = file.content()
        yield pick(rng, BYTE_MUTATIONS)(content, rng) if kind in (1, 2) else content


def compare(count: int = COUNT, seed: int = 0) -> dict[str, int]:
    """Numbers of files that were compared, accepted by the library, and treated differently by a reader of ours."""
    counts: collections.Counter[str] = collections.Counter()
    for content, accepted, reason in verdicts(count, seed):
        counts.update({"compared": 1, "accepted": accepted, "differ": bool(reason)})
        if reason:
            print(f"{reason}: {content[:300]!r}")
    return {f"reader_verdicts_{name}": counts[name] for name in ("compared", "accepted", "differ")}


def verdicts(count: int, seed: int = 0) -> Iterator[tuple[bytes, bool, str]]:
    """Damaged files, whether the library accepts each, and how our readers differ: empty where they agree."""
    with tempfile.TemporaryDirectory(prefix="primdiffusion_verdicts_") as name:
        path = Path(name) / "a.human"
        for content in damaged_files(count, seed):
            path.write_bytes(content)
            yield content, *difference(path, content)


def difference(path: Path, content: bytes) -> tuple[bool, str]:
    """Whether the library accepts a file, and what our readers find otherwise; empty where they agree."""
    expected = _library(path, content)
    layout = _or_none(lambda: read_layout(io.BytesIO(content), LONGEST_HEADER), ValueError)
    accepted = expected is not None
    if (layout is not None) != accepted:
        return accepted, "the format's verdicts differ"
    ours = _or_none(lambda: read_tensors(path), ValueError)
    theirs = _or_none(lambda: tensor_file.opened(path), ValueError)
    if layout is None or expected is None:
        return accepted, "" if ours is None and theirs is None else "a program accepts it alone"
    if (layout.metadata, {name: _found(layout, content, name) for name in layout.tensors}) != expected:
        return accepted, "the format's contents differ"
    within = _or_none(lambda: check_limits(layout) or True, ValueError) is not None
    is_human = layout.metadata.get("format") == HUMAN["format"]
    if (ours is not None) != (within and is_human) or (theirs is not None) != within:
        return accepted, "the programs' verdicts differ"
    if theirs is None:
        return accepted, ""
    for name, (dtype, shape, raw) in expected[1].items():
        if not _is_same(theirs.tensor(name), dtype, shape, raw):
            return accepted, "the backend's contents differ"
        if ours is not None and not _is_equal(ours, name, expected[1]):
            return accepted, "the extension's contents differ"
    return accepted, ""


Contents = dict[str, tuple[str, tuple[int, ...], bytes]]


def _library(path: Path, content: bytes) -> tuple[dict[str, str], Contents] | None:
    try:
        found = safetensors.deserialize(content)
        with safetensors.safe_open(path, framework="np") as file:
            texts = file.metadata() or {}
    except safetensors.SafetensorError:
        return None
    return texts, {name: (one["dtype"], tuple(one["shape"]), bytes(one["data"])) for name, one in found}


def _or_none(read: Callable[[], Any], error: type[Exception]) -> Any:
    try:
        return read()
    except error:
        return None


def _found(layout: TensorLayout, content: bytes, name: str) -> tuple[str, tuple[int, ...], bytes]:
    stored = layout.tensors[name]
    return stored.dtype, stored.shape, bytes(layout.raw(content, name))


def _is_equal(human: HumanTensors, name: str, expected: Contents) -> bool:
    dtype, shape, raw = human.arrays[name]
    return (dtype, shape, bytes(raw)) == expected[name] and set(human.arrays) == set(expected)


def _is_same(tensor: torch.Tensor, dtype: str, shape: tuple[int, ...], raw: bytes) -> bool:
    """Whether a tensor is what numpy reads; by bytes, since numpy has no bfloat16."""
    expected = np.frombuffer(raw, DTYPES[dtype]).reshape(shape)
    found = tensor.contiguous().reshape(-1).view(torch.uint8).numpy()
    return tuple(tensor.shape) == expected.shape and found.tobytes() == expected.tobytes()
