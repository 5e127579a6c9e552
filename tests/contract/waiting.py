"""Waiting for what a child tells the client."""

import sys
import time
from pathlib import Path

from blender_primdiffusion.backend.client import BackendClient

PYTHON = Path(sys.executable)
BACKEND = Path(__file__).resolve().parents[2] / "backend"
"""The checkout's own: a child sees no PYTHONPATH of the tests."""


def wait_for(client: BackendClient, wanted, timeout_s: float = 300, into: list | None = None):
    """The first event that `wanted` accepts; all events seen go `into` a list."""
    seen = into if into is not None else []
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        for event in client.poll():
            seen.append(event)
            if wanted(event):
                return event
        time.sleep(0.005)
    raise AssertionError(f"not within {timeout_s} s; seen {seen}; stderr {client.stderr}")


def run_to_end(work):
    """What a generator returns; sleeps at each of its yields."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            return done.value
        time.sleep(0.02)
