"""A human of the backend, and the extension registered once for a file of tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from engine_stage import PYTHON, Oracle

import blender_primdiffusion


@pytest.fixture(scope="module")
def oracle(tmp_path_factory) -> Iterator[Oracle]:
    oracle = Oracle(tmp_path_factory.mktemp("oracle"))
    yield oracle
    oracle.close()


@pytest.fixture(scope="module")
def folder(oracle, tmp_path_factory) -> Path:
    """The files of a human: `human.npz`, `few.npz` with few primitives, `person.human.safetensors`."""
    return oracle.make(tmp_path_factory.mktemp("human"))


@pytest.fixture(scope="module")
def extension() -> Iterator[None]:
    """Registered once: the child is kept warm between the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PRIMDIFFUSION_PYTHON", PYTHON)
        blender_primdiffusion.register()
        yield
        blender_primdiffusion.unregister()
