"""A small checkpoint, a person of it, and command lines that fail."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from primdiffusion.human import Human, generate
from support.tiny import save_tiny_checkpoint, tiny_model


class Failed(NamedTuple):
    """How a command ended, and what it printed."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    """Of `tiny_model`; not to be changed."""
    return save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors")


@pytest.fixture(scope="session")
def human() -> Human:
    """A person of `tiny_model`; not to be changed."""
    return generate(tiny_model(), seed=3, steps=5)


@pytest.fixture
def fails(capsys) -> Callable[..., Failed]:
    """Run a command line that must fail; its words may be paths and numbers."""
    from primdiffusion import cli

    def fails(*words: object) -> Failed:
        with pytest.raises(SystemExit) as end:
            cli.main([str(word) for word in words])
        return Failed(end.value.code, *capsys.readouterr())

    return fails
