"""Seeded damage to files and messages."""

from __future__ import annotations

import io
import json
import math
import struct
import warnings
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator

NUMBERS = (
    b"0", b"-1", b"-0.0", b"1", b"2", b"255", b"256", b"65536", b"2147483648", b"9223372036854775808", b"1e39",
    b"1e300", b"1e-320", b"-1e300", b"nan", b"inf", b"-inf", b"NaN", b"Infinity", b"1" * 400,
    b"0x10", b"1_0", "٣".encode(), b"",
)  # fmt: skip
WORDS = (
    b"null",
    b"true",
    b"[]",
    b"{}",
    b'""',
    b"../",
    b"/dev/zero",
    b"/proc/self/mem",
    b"\0",
    b"\xff\xfe",
    b"\r\n",
    b"%s",
)
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 2**31, 2**63, 10**400, 1e300, 5e-324, float("nan"), float("inf"), "", "x" * 300, "../..", "\0",
    [], {}, [[]], [None], [1e300] * 24, {"a": 1}, "/dev/zero", [[[[[[[[1]]]]]]]],
)  # fmt: skip
EXTREMES = (float("nan"), float("inf"), 1e300, -1e300, 1e38, -1e38, 9e8, -1.0)
LENGTHS = (0, 1, 2, 7, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1)

SHAPES = (
    "()", "(0,)", "(-1,)", "(1,)", "(1000000000,)", "(50000000, 72)", "(2, 2)", "(4611686018427387904, 8)",
    "None", "(1.5,)", "(True,)",
)  # fmt: skip
KINDS = ("'<f8'", "'<f4'", "'|O'", "'|S5'", "'<i8'", "'<c16'", "'|b1'", "'<U9'", "'>f2'", "[('a', '<f4')]")

PICKLES = (
    b"cbuiltins\nbytearray\nI8000000000\n\x85R.", b"ctorch\nFloatTensor\nI2000000000\n\x85R.", b"(" * 2_000_000 + b".",
    b"cos\nsystem\n(S'touch CANARY'\ntR.", b"Np300000000\n.", b"ctorch._utils\n_rebuild_meta_tensor_no_storage\n)R.",
)  # fmt: skip
TENSOR_KINDS = (
    ("F64", 8), ("F32", 4), ("F16", 2), ("BF16", 2), ("F8_E4M3", 1), ("C64", 8), ("I64", 8), ("U16", 2), ("U8", 1),
    ("BOOL", 1),
)  # fmt: skip
"""And their bytes."""

Mutation = Callable[[bytes, Generator], bytes]


def pick(rng: Generator, of: Sequence[Any]) -> Any:
    return of[int(rng.integers(len(of)))]


def flip(content: bytes, rng: Generator) -> bytes:
    """Some bytes become others; the beginning, where headers are, as often as the rest."""
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        end = len(changed) if rng.random() < 0.5 else min(len(changed), 512)
        if end:
            changed[int(rng.integers(end))] = int(rng.integers(256))
    return bytes(changed)


def truncate(content: bytes, rng: Generator) -> bytes:
    return content[: int(rng.integers(len(content) + 1))]


def splice(content: bytes, rng: Generator) -> bytes:
    """A piece is repeated, moved or left out."""
    a, b, c = sorted(int(rng.integers(len(content) + 1)) for _ in range(3))
    return pick(
        rng, (content[:a] + content[b:], content[:b] + content[a:c] * 3 + content[c:], content[b:] + content[:b])
    )


def integer(content: bytes, rng: Generator) -> bytes:
    """A length in the first bytes becomes another."""
    if len(content) < 16:
        return content
    size, order = pick(rng, ((4, "<I"), (8, "<Q"), (4, ">I"), (2, "<H")))
    place = int(rng.integers(min(len(content), 256) - size))
    value = pick(rng, LENGTHS) % (1 << (8 * size))
    return content[:place] + struct.pack(order, value) + content[place + size :]


def words(content: bytes, rng: Generator) -> bytes:
    """Numbers and words of a text become hostile ones."""
    parts = content.split(b" ") if content.count(b" ") > 8 else content.split(b",")
    for _ in range(int(rng.integers(1, 6))):
        parts[int(rng.integers(len(parts)))] = pick(rng, NUMBERS + WORDS)
    return (b" " if content.count(b" ") > 8 else b",").join(parts)


def lines(content: bytes, rng: Generator) -> bytes:
    """Lines are exchanged, repeated or left out."""
    parts = content.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        a, b = int(rng.integers(len(parts))), int(rng.integers(len(parts)))
        parts[a : a + 1] = pick(rng, ([], [parts[b]], [parts[a], parts[b]], [parts[a]] * 50))
        parts = parts or [b""]
    return b"\n".join(parts)


def tree(value: Any, rng: Generator) -> Any:
    """A JSON value of which some inner value is another, is missing, or is there under a wrong name."""
    if rng.random() < 0.25 or not isinstance(value, (dict, list)) or not value:
        return pick(rng, VALUES)
    if isinstance(value, dict):
        key = pick(rng, list(value))
        changed = dict(value)
        chance = rng.random()
        if chance < 0.15:
            del changed[key]
        elif chance < 0.25:
            changed[pick(rng, ("", "x", "__class__", key + " "))] = changed.pop(key)
        else:
            changed[key] = tree(value[key], rng)
        return changed
    place = int(rng.integers(len(value)))
    chance = rng.random()
    if chance < 0.15:
        return value[:place]
    if chance < 0.3:
        return value + value[: place + 1]
    return [*value[:place], tree(value[place], rng), *value[place + 1 :]]


def as_json(content: bytes, rng: Generator) -> bytes:
    """A value inside a JSON file becomes another."""
    changed = json.loads(content)
    for _ in range(int(rng.integers(1, 4))):
        changed = tree(changed, rng)
    text = json.dumps(changed)
    return (b"[" * int(rng.integers(1, 200_000)) if rng.random() < 0.02 else b"") + text.encode()


def safetensors_header(content: bytes, rng: Generator) -> bytes:
    """An entry of the header, or of a JSON object in its metadata, becomes another; the data stay."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    metadata = header.get("__metadata__", {})
    inner = [name for name, text in metadata.items() if text.startswith("{")]
    if inner and rng.random() < 0.5:
        name = pick(rng, inner)
        metadata[name] = as_json(metadata[name].encode(), rng).decode()
    else:
        header = tree(header, rng)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + content[end:]


def safetensors_kind(content: bytes, rng: Generator) -> bytes:
    """A tensor has another type and as many bytes as that needs, so that the file is whole."""

    def change(entry: dict[str, Any], _raw: bytes) -> bytes:
        entry["dtype"], size = pick(rng, TENSOR_KINDS)
        return pick(rng, (b"\0", b"\1", b"\xff")) * (math.prod(entry["shape"]) * size)

    return _one_tensor(content, rng, change)


def safetensors_shape(content: bytes, rng: Generator) -> bytes:
    """A tensor has another shape and the bytes that it needs, so that the file is whole."""

    def change(entry: dict[str, Any], raw: bytes) -> bytes:
        shape, values = entry["shape"], max(math.prod(entry["shape"]), 1)
        size = max(len(raw) // values, 1)
        axis = int(rng.integers(len(shape) + 1))
        if axis == len(shape):
            entry["shape"] = pick(rng, ([], [0], [1, *shape], [*shape, 1], shape[1:], shape[::-1]))
        else:
            shape[axis] = pick(rng, (0, 1, shape[axis] - 1, shape[axis] + 1, 2 * shape[axis]))
            entry["shape"] = [max(length, 0) for length in shape]
        needed = math.prod(entry["shape"]) * size
        return (raw * (needed // max(len(raw), 1) + 1) if raw else b"\0" * needed)[:needed]

    return _one_tensor(content, rng, change)


def _one_tensor(content: bytes, rng: Generator, change: Callable[[dict[str, Any], bytes], bytes]) -> bytes:
    """A file in which one tensor is what `change` makes of its entry and bytes."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    names = sorted((name for name in header if name != "__metadata__"), key=lambda one: header[one]["data_offsets"])
    chosen, data = pick(rng, names), b""
    for name in names:
        begin, stop = header[name]["data_offsets"]
        raw = content[end + begin : end + stop]
        if name == chosen:
            raw = change(header[name], raw)
        header[name]["data_offsets"] = [len(data), len(data) + len(raw)]
        data += raw
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def archive(content: bytes, rng: Generator) -> bytes:
    """A member of a zip archive is damaged, missing, doubled, renamed or replaced by another."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = [(info.filename, file.read(info)) for info in file.infolist()]
    place = int(rng.integers(len(members)))
    name, data = members[place]
    chance = rng.random()
    if chance < 0.1:
        del members[place]
    elif chance < 0.2:
        members.append((name, data))
    elif chance < 0.3:
        members[place] = (pick(rng, ("../../x.npy", "x" * 300, "/etc/x", name[:-4], "")) or "y", data)
    elif chance < 0.4:
        members[place] = (name, pick(rng, members)[1])
    else:
        members[place] = (
            name,
            pick(rng, (npy_header, npy_header, npy_shape, npy_shape, npy_values, flip, truncate, integer))(data, rng),
        )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as file:
        for name, data in members:
            file.writestr(name, data)
    return out.getvalue() if rng.random() < 0.9 else flip(out.getvalue(), rng)


def torch_pickle(content: bytes, rng: Generator) -> bytes:
    """The pickle of a file of torch.save becomes one that calls, or takes memory."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as file, zipfile.ZipFile(out, "w") as changed:
        for info in file.infolist():
            is_pickle, whole = info.filename.endswith("data.pkl"), file.read(info)
            if is_pickle and rng.random() < 0.3:  # two pickles, of which one is whole
                name = pick(rng, (info.filename, info.filename.upper(), info.filename.replace("/", "\\")))
                pickles = [(info.filename, whole), (name, pick(rng, PICKLES))]
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of a name that is there twice
                    for one, content_of_one in pickles[:: pick(rng, (1, -1))]:
                        changed.writestr(one, content_of_one)
                continue
            changed.writestr(info.filename, pick(rng, PICKLES) if is_pickle else whole)
    return out.getvalue()


def npy_header(content: bytes, rng: Generator) -> bytes:
    """The header of an array promises another shape, type or order."""
    if content[:6] != b"\x93NUMPY":
        return flip(content, rng)
    length = int.from_bytes(content[8:10], "little")
    shape = pick(rng, SHAPES)
    kind = pick(rng, KINDS)
    order = pick(rng, ("False", "True", "0"))
    text = f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}, }}".encode()
    if rng.random() < 0.1:
        text = b"[" * 20_000 + text
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return content[:8] + (len(text) % 65536).to_bytes(2, "little") + text + content[10 + length :]


def npy_shape(content: bytes, rng: Generator) -> bytes:
    """An array is shorter, longer, of more or fewer axes, or of another type, and whole."""
    array = np.load(io.BytesIO(content), allow_pickle=False)
    axis = int(rng.integers(array.ndim + 1))
    if axis == array.ndim:
        array = pick(rng, (array[None], array[..., None], array.T, array.ravel()[:1].reshape(()), array.ravel()[:0]))
    elif rng.random() < 0.3:
        array = array.astype(pick(rng, ("u1", "i8", "?", "f2", "f8", "c8", "U3", "S3", "M8[s]")))
    else:
        length = pick(rng, (0, 1, max(array.shape[axis] - 1, 0), array.shape[axis] + 1, 2 * array.shape[axis]))
        array = np.take(array, np.arange(length) % max(array.shape[axis], 1), axis)
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npy_values(content: bytes, rng: Generator) -> bytes:
    """Values of an array become extreme ones."""
    if content[:6] != b"\x93NUMPY" or len(content) < 140:
        return flip(content, rng)
    start = 10 + int.from_bytes(content[8:10], "little")
    value = pick(rng, EXTREMES)
    if rng.random() < 0.1:  # as an array of integers, whose smallest has no magnitude
        count = (len(content) - start) // 8
        head = f"{{'descr': '<i8', 'fortran_order': False, 'shape': ({count},), }}".ljust(117).encode() + b"\n"
        return content[:8] + len(head).to_bytes(2, "little") + head + struct.pack("<q", -(2**63)) * count
    value = struct.pack("<d", value) if abs(value) > 1e38 or rng.random() < 0.5 else struct.pack("<f", value)
    places = max(1, (len(content) - start) // len(value))
    place = start + len(value) * int(rng.integers(places))
    return content[:place] + value + content[place + len(value) :]


PLAIN: tuple[Mutation, ...] = (flip, truncate, splice, integer)
TEXT: tuple[Mutation, ...] = (flip, truncate, words, words, words, lines, lines)
JSON: tuple[Mutation, ...] = (as_json, as_json, as_json, as_json, words, flip, truncate)
NPZ: tuple[Mutation, ...] = (archive, archive, archive, archive, flip, truncate, integer)
TORCH: tuple[Mutation, ...] = (*NPZ, *PLAIN, torch_pickle)
SAFETENSORS: tuple[Mutation, ...] = (
    safetensors_kind,
    safetensors_shape,
    safetensors_shape,
    safetensors_header,
    safetensors_header,
    safetensors_header,
    flip,
    truncate,
    integer,
)
