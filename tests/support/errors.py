"""Errors by their kind and by what they name, not by their words."""

import contextlib
from collections.abc import Iterator

import pytest


@contextlib.contextmanager
def refused(
    kind: type[Exception] | tuple[type[Exception], ...], *names: str
) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """An error of this kind, whose message has all of these names.

    A name is what a user finds the fault by: a field, a file, a value, a button; one word of the fault where there is
    none. None at all for a kind that has one meaning.
    """
    with pytest.raises(kind) as caught:
        yield caught
    for name in names:
        assert name in str(caught.value)
