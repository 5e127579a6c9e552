"""The metadata of .human files that both programs check alike: the format's version, and how the human was made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NoReturn

from . import compact_human
from .json_files import LARGEST_INTEGER, parse_json, parse_message

_KINDS: dict[str, tuple[str, Any]] = {
    "seed": ("an integer", int),
    "steps": ("an integer", int),
    "sampler": ("a string", str),
    "guidance": ("a number", (int, float)),
    "checkpoint": ("a string", str),
    "checkpoint_sha256": ("a string", str),
    "full_density": ("a number", (int, float)),
    "version": ("a string", str),
}


def version_fault(metadata: Mapping[str, str]) -> str | None:
    """Why a file's version cannot be read, if so: the end of a sentence that begins with the file's name."""
    version = metadata.get("format_version", "")
    newest = compact_human.FORMAT_VERSION
    if not (version.isascii() and version.isdecimal() and len(version) <= 9) or int(version) < 1:
        return f"does not contain a valid human (format version {version!r:.9}): generate it again"
    if int(version) > newest:
        return f"was written by a newer PrimDiffusion (format {version}, this one reads up to {newest}): update it"
    return None


def provenance_of(metadata: Mapping[str, str]) -> dict[str, Any]:
    """How the human was made. Raises ValueError for what is no JSON object or has entries of a wrong type."""
    text = metadata.get("provenance", "")
    try:
        provenance = parse_message(text)
    except ValueError as error:
        raise _no_json(error) from error
    check_provenance(provenance)  # first: it names the entry that is NaN
    try:
        return parse_json(text)
    except ValueError as error:
        raise _no_json(error) from error


def _no_json(error: ValueError) -> ValueError:
    return ValueError(f"its provenance is not JSON ({error!s:.100}): generate the human again")


def check_provenance(provenance: Any) -> None:
    """Raise ValueError, naming the entry, for one of a wrong type."""
    if not isinstance(provenance, Mapping):
        raise ValueError(f"its provenance is {provenance!r:.60}, not a JSON object: generate the human again")
    for name, (wanted, kind) in _KINDS.items():
        if name in provenance and not _is(provenance[name], kind):
            _reject(name, provenance[name], wanted)
    _check_attributes("attributes", provenance.get("attributes", {}))
    if not provenance.get("full_density", 1) > 0:
        _reject("full_density", provenance["full_density"], "above zero")
    edits = provenance.get("edits", [])
    if not isinstance(edits, list):
        _reject("edits", edits, "a list of objects")
    for edit in edits:
        if not isinstance(edit, Mapping) or not _is(edit.get("edit"), str):
            _reject("edits", edit, 'objects with a name "edit"')


def _check_attributes(name: str, attributes: Any) -> None:
    wanted = "an object of strings and numbers"
    if not isinstance(attributes, Mapping):
        _reject(name, attributes, wanted)
    for value in attributes.values():
        if not _is(value, (str, int, float)):
            _reject(name, value, wanted)


def _is(value: Any, kind: Any) -> bool:
    if isinstance(value, bool) or (isinstance(value, float) and not math.isfinite(value)):
        return False
    return isinstance(value, kind) and not (isinstance(value, int) and abs(value) > LARGEST_INTEGER)


def _reject(name: str, value: Any, wanted: str) -> NoReturn:
    raise ValueError(f"{name!r} of its provenance is {value!r:.60}, not {wanted}: generate the human again")
