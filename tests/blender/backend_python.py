"""This interpreter as the child's Python, found without being tried."""

import os
import sys
from pathlib import Path

import pytest

from blender_primdiffusion import places
from blender_primdiffusion.backend.client import BackendClient

ORDERS = "FAKE_"
"""Beginning of the variables that tell the fake child what to do; the extension itself passes none of them on."""


def fake_client(python: Path, module_path: Path | None, *, cache_dir: Path | None = None) -> BackendClient:
    """A client whose child gets the variables of ORDERS that are set at this time."""
    orders = {name: value for name, value in os.environ.items() if name.startswith(ORDERS)}
    return BackendClient(python, module_path, orders, cache_dir=cache_dir)


def use_this_python(patch: pytest.MonkeyPatch, backend: Path | None = None) -> None:
    """The child runs on this interpreter; `backend` holds the package that it imports, by default the real one."""
    found = ("the test", Path(sys.executable))
    patch.setattr("blender_primdiffusion.backend.environment.find_python", lambda *_: found)
    if backend:
        patch.setattr(places, "backend_module_path", lambda: backend)
        patch.setattr(places, "BackendClient", fake_client)
