"""The child asked for one thing, and waited for: by commands, which have nothing else to do."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy

from ...console import Stop
from ...places import EXTENSION, new_backend, preference
from ...worker.backend import Backend
from ...worker.environment import VARIABLE
from ...worker.request import Request

_TICK_S = 0.03


class NoBackend(RuntimeError):
    """No Python runs the backend; the message names those that were tried."""


class ChildFailed(RuntimeError):
    """The child could not do what it was asked for; the message is for the user."""


class Stopped(Exception):
    """Told to stop."""


@contextmanager
def backend_of(python: Path | None) -> Iterator[Backend]:
    """A child of this Python, or of the preferences'; started at first use, ended with the block."""
    backend = new_backend(str(python) if python is not None else preference("backend_python"))
    try:
        yield backend
    finally:
        backend.shutdown()


@contextmanager
def everywhere(python: Path | None) -> Iterator[None]:
    """This Python for the render engine too, which asks the preferences and the environment."""
    if python is None:
        yield
        return
    addon = bpy.context.preferences.addons.get(EXTENSION)
    before, variable = (addon.preferences.backend_python if addon else ""), os.environ.get(VARIABLE)
    os.environ[VARIABLE] = str(python)
    if addon is not None:
        addon.preferences.backend_python = str(python)
    try:
        yield
    finally:
        if addon is not None:
            addon.preferences.backend_python = before
        if variable is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = variable


def check_backend(python: Path | None) -> None:
    """Raises NoBackend where no child can be started."""
    with backend_of(python) as backend:
        try:
            backend.connect()
        except (RuntimeError, OSError) as error:
            raise NoBackend(str(error)) from error


def ask(
    backend: Backend,
    method: str,
    params: Mapping[str, Any],
    stop: Stop,
    tell: Callable[[Request], None] = lambda _job: None,
) -> dict[str, Any]:
    """The child's answer; `tell` hears of the job's progress.

    Raises NoBackend, ChildFailed, and Stopped once `stop` is set, within a second; then no file is left.
    """
    job = Request(backend, method, params)
    while not job.finished:
        if stop.is_set():
            job.cancel()
        if job.tick():
            tell(job)
        time.sleep(_TICK_S)
    if job.state == "cancelled":
        raise Stopped
    if job.error is not None:
        raise (NoBackend if job.error.kind == "environment" else ChildFailed)(str(job.error))
    return job.result or {}
