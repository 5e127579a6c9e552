"""Requests of the extension's works, for tests with the real child."""

import sys
from pathlib import Path

from waiting import BACKEND

from blender_primdiffusion.backend.client import BackendClient
from blender_primdiffusion.backend.requests import Backend, ChildRequest


def this_pythons_backend(**settings) -> Backend:
    """The real child on the Python that runs the tests; `settings` of the client."""

    return Backend(lambda: BackendClient(Path(sys.executable), BACKEND, **settings))


def generate_request(backend: Backend, *, out_dir: Path, checkpoint: Path | None = None, **params) -> ChildRequest:
    """A person from noise."""
    chosen = {} if checkpoint is None else {"checkpoint": str(checkpoint)}
    return ChildRequest(backend, "generate", {**params, **chosen, "out_dir": str(out_dir), "size": 16})
