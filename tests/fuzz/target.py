"""A kind of file or message: a valid one, how it is damaged, how it is read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fuzz.mutations import Mutation

Read = Callable[[Path], None]


class Garbage(AssertionError):
    """A value that no reader should let through."""


@dataclasses.dataclass(frozen=True)
class Target:
    """A kind of input."""

    name: str
    make: Callable[[Path], Path]
    """Writes a valid file into a folder and returns its path."""
    mutations: Sequence[Mutation]
    read: Read
    """Reads the damaged file. Raises Garbage for values that should have been refused."""
    is_file: bool = True
    """A file of the user's, which a sentence about it names; otherwise a message."""
    seconds: float = 2.0
    """Of the processor, at the most."""


def finite(*values: Any) -> None:
    """Raises Garbage for an array with NaN, infinities or numbers that no quantity here has."""
    for value in values:
        array = np.asarray(value.detach() if isinstance(value, torch.Tensor) else value)
        if array.dtype.kind in "fc" and array.size and not (np.abs(array) < 1e12).all():
            raise Garbage(f"{array.dtype} {array.shape} with {array.flat[np.abs(array).argmax()]}")


def finite_members(*records: Any) -> None:
    """As `finite`, of all arrays that records hold."""
    for record in records:
        finite(*(value for value in vars(record).values() if isinstance(value, np.ndarray | torch.Tensor)))


def said(error: BaseException) -> str | None:
    """The sentence that a user reads for this error; None for one that is shown with a traceback."""
    from primdiffusion.failures import describe
    from primdiffusion.serve.server import RpcError

    if isinstance(error, RpcError):
        return str(error)
    description = describe(error)
    return None if description is None else str(description)
