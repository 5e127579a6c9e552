"""The metadata of .human files that both programs check alike: the format's version, and how the human was made."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

from . import compact_human
from .json_files import parse_json, parse_message
from .schema import FieldError, Open, Range, read


@dataclasses.dataclass(frozen=True, kw_only=True)
class Edit(Open):
    """A later edit."""

    edit: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Provenance(Open):
    """How a human was made; a file need not state all of it, and may state more."""

    seed: int = 0
    steps: int = 0
    sampler: str = ""
    guidance: float = 1.0
    attributes: dict[str, str | float] = dataclasses.field(default_factory=dict)
    checkpoint: str = ""
    checkpoint_sha256: str = ""
    full_density: Annotated[float, Range(1e-30, 1e30)] = 1.0
    version: str = ""
    edits: list[Edit] = dataclasses.field(default_factory=list)


def version_fault(metadata: Mapping[str, str]) -> tuple[str, str] | None:
    """Why a file's version cannot be read, if so: reason and remedy of a FileError."""
    version = metadata.get("format_version", "")
    newest = compact_human.FORMAT_VERSION
    if not (version.isascii() and version.isdecimal() and len(version) <= 9) or int(version) < 1:
        return f"does not contain a valid human (format version {version!r:.9})", "generate it again"
    if int(version) > newest:
        return f"has format {version} of a newer PrimDiffusion, this one reads up to {newest}", "update PrimDiffusion"
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
    return ValueError(f"its provenance is not JSON ({error!s:.100})")


def check_provenance(provenance: Any) -> None:
    """Raise ValueError, naming the entry, for one of a wrong type."""
    if not isinstance(provenance, Mapping):
        raise ValueError(f"its provenance is {provenance!r:.60}, not a JSON object")
    try:
        read(Provenance, provenance)
    except FieldError as error:
        raise ValueError(f"{error.field!r} of its provenance is not valid") from error
