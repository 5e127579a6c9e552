"""Words of programs as people write them."""

from __future__ import annotations


def sentence(text: BaseException | str) -> str:
    """`text` with a capital and a full stop; the kind of an error that says nothing."""
    said = str(text).strip() or type(text).__name__
    said = said[:1].upper() + said[1:]
    return said if said.endswith((".", "!", "?")) else f"{said}."
