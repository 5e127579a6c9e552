"""The self-test: the real child is started on a Python, says who it is and makes a person in a few steps."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .client import BackendClient, Died, Event, Failure, Notification, Response
from .environment import BackendNotFound, search
from .polling import run_to_end
from .setup_pip import SetUpFailed

STEPS = 3
READY_S = 300.0
"""A first import of torch compiles its byte code; a virus scanner reads along."""
PERSON_S = 300.0
_PICTURE_PX = 16


@dataclasses.dataclass(frozen=True)
class Tried:
    """How it went."""

    device: str
    seconds: float
    """From the start of the child to the finished person."""
    torch: str
    python: str
    version: str


def try_backend(
    python: Path, module_path: Path | None, cache_dir: Path | None, temporary: Path
) -> Iterator[str | Tried]:
    """Sentences on what is being tried, last the result. Raises SetUpFailed in a sentence."""
    yield "Starting the backend"
    try:
        found = run_to_end(search(python, module_path=module_path, cache_dir=cache_dir, timeout_s=READY_S))
    except BackendNotFound as error:
        raise SetUpFailed(f"the self-test failed: {error}") from error
    began = time.monotonic()
    client = BackendClient(python, module_path, cache_dir=cache_dir)
    client.start()
    try:
        _wait_until_ready(client)
        yield f"Generating a person on {client.info.get('device_name') or 'the CPU'}"
        with tempfile.TemporaryDirectory(dir=temporary) as folder:
            asked = {"seed": 0, "out_dir": str(Path(folder, "person")), "steps": STEPS, "size": _PICTURE_PX}
            result = _answer(client, client.request("generate", asked))
            if not Path(result.get("human", "")).is_file():
                raise SetUpFailed("the self-test failed: the backend made no person and did not say why")
    finally:
        client.shutdown()
    device = client.info.get("device_name") or ""
    yield Tried(device, round(time.monotonic() - began, 1), found.torch, found.python, found.version)


def _wait_until_ready(client: BackendClient) -> None:
    for event in _events(client, READY_S):
        if isinstance(event, Notification) and event.method == "ready":
            if event.params.get("problem"):
                raise SetUpFailed(f"the self-test failed: {event.params['problem']}")
            return


def _answer(client: BackendClient, request: int) -> dict[str, Any]:
    for event in _events(client, PERSON_S):
        if isinstance(event, Failure) and event.id == request:
            raise SetUpFailed(f"the self-test failed: {event.message}")
        if isinstance(event, Response) and event.id == request:
            return event.result or {}
    raise SetUpFailed("the self-test failed: the backend did not answer")


def _events(client: BackendClient, patience_s: float) -> Iterator[Event]:
    began = time.monotonic()
    while time.monotonic() - began < patience_s:
        for event in client.poll():
            if isinstance(event, Died):
                last = f" ({event.stderr[-1]})" if event.stderr else ""
                raise SetUpFailed(f"the self-test failed: {event.message}{last}")
            yield event
        client.wait(0.1)
    raise SetUpFailed(f"the self-test failed: the backend said nothing for {patience_s:.0f} s")
