"""Two inputs of one kind become one: two headers, the members of two archives, two trees, two messages."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable, Sequence

from numpy.random import Generator

from fuzz.mutations import pick

Combination = Callable[[bytes, bytes, Generator], bytes]


def combined(first: bytes, second: bytes, rng: Generator) -> bytes:
    """Parts of both, by their format where it is known and its structure is whole, and as bytes otherwise."""
    ways = [way for begins, way in _WAYS if begins(first) and begins(second)]
    try:
        return pick(rng, [halves, *ways * 4])(first, second, rng)
    except Exception:  # damaged before
        return halves(first, second, rng)


def halves(first: bytes, second: bytes, rng: Generator) -> bytes:
    """The beginning of one and the end of the other, or a piece of one within the other."""
    place, begin, end = int(rng.integers(len(first) + 1)), *sorted(rng.integers(len(second) + 1, size=2).tolist())
    return first[:place] + pick(rng, (second[end:], second[begin:end] + first[place:]))


def headers(first: bytes, second: bytes, rng: Generator) -> bytes:
    """Safetensors: the header of one before the data of the other, or the tensors of both, or two headers."""
    (text, data), (other, more) = _parts(first), _parts(second)
    way = int(rng.integers(4))
    if way == 0:
        return len(other).to_bytes(8, "little") + other + data
    if way == 1:
        length = pick(rng, (len(text), len(other), len(text) + len(other)))
        return length.to_bytes(8, "little") + text + other + data
    entries = list(json.loads(text, object_pairs_hook=list))
    for name, fields in json.loads(other, object_pairs_hook=list):
        if way == 2 and name != "__metadata__":
            fields = [(field, [n + len(data) for n in v] if field == "data_offsets" else v) for field, v in fields]
            entries.append((name, fields))
        elif way == 3 and name == "__metadata__":
            entries = [entry for entry in entries if entry[0] != name] + [(name, fields)]
    header = _object([(name, _object([(k, json.dumps(v)) for k, v in fields])) for name, fields in entries])
    return len(header).to_bytes(8, "little") + header.encode() + data + (more if way == 2 else b"")


def _parts(content: bytes) -> tuple[bytes, bytes]:
    end = 8 + int.from_bytes(content[:8], "little")
    return content[8:end], content[end:]


def _object(fields: Sequence[tuple[str, str]]) -> str:
    """JSON of names and JSON texts; a name may occur twice."""
    return "{" + ",".join(f"{json.dumps(name)}:{text}" for name, text in fields) + "}"


def archives(first: bytes, second: bytes, rng: Generator) -> bytes:
    """Zip: members of both, of which some have one name, or one archive behind the other."""
    if rng.random() < 0.2:
        return first + second
    members, others = _members(first), _members(second)
    place, (name, data) = int(rng.integers(len(members))), pick(rng, others)
    before, after = members[:place], members[place + 1 :]
    ways = (
        [*members, (name, data)],
        [*members, *others],
        [*before, (members[place][0], data), *after],
        [*before, (name, data), *after],
    )
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", pick(rng, (0, zipfile.ZIP_DEFLATED))) as file:
        warnings.simplefilter("ignore")  # of a name that is there twice
        for name, data in pick(rng, ways):
            file.writestr(name, data)
    return out.getvalue()


def _members(content: bytes) -> list[tuple[str, bytes]]:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        return [(info.filename, file.read(info)) for info in file.infolist()]


def chunks(first: bytes, second: bytes, rng: Generator) -> bytes:
    """GLB: chunks of both, in any order and number."""
    found = [*_chunks(first), *_chunks(second)]
    body = b"".join(found[place] for place in rng.permutation(len(found))[: int(rng.integers(1, 4))])
    return first[:8] + (12 + len(body)).to_bytes(4, "little") + body


def _chunks(content: bytes) -> list[bytes]:
    found, place = [], 12
    while place < len(content):
        end = place + 8 + int.from_bytes(content[place : place + 4], "little")
        found.append(content[place:end])
        place = end
    return found


def trees(first: bytes, second: bytes, rng: Generator) -> bytes:
    """JSON: a branch of one in the other, entries of both in one object, or one text behind the other."""
    if rng.random() < 0.2:
        return first + pick(rng, (b"", b"\n")) + second
    tree, other = json.loads(first), json.loads(second)
    if rng.random() < 0.3 and isinstance(tree, dict) and isinstance(other, dict):
        pairs = [(name, json.dumps(value)) for name, value in (*tree.items(), *other.items())]
        return _object(pairs).encode()
    place, branch = pick(rng, _containers(tree)), pick(rng, _containers(other))
    place[pick(rng, list(place) if isinstance(place, dict) else range(len(place)))] = pick(
        rng, (branch, pick(rng, list(branch.values() if isinstance(branch, dict) else branch)))
    )
    return json.dumps(tree).encode()


def _containers(value: object) -> list:
    """The lists and objects of a tree that hold something."""
    found = [value] if isinstance(value, dict | list) and value else []
    for container in found:
        entries = container.values() if isinstance(container, dict) else container
        found += [entry for entry in entries if isinstance(entry, dict | list) and entry]
    return found


_WAYS: tuple[tuple[Callable[[bytes], bool], Combination], ...] = (
    (lambda content: content[8:9] == b"{", headers),
    (lambda content: content[:4] == b"PK\3\4", archives),
    (lambda content: content[:4] == b"glTF", chunks),
    (lambda content: content[:1] in (b"{", b"["), trees),
)
"""How inputs of a kind begin, and what is made of two."""
