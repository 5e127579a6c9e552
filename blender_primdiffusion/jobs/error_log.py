"""Errors of jobs, and the log for a bug report."""

from __future__ import annotations

import contextlib
import os
import platform
import tempfile
import tomllib
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..backend.requests import RequestError, error_text, sentence
from ..places import EXTENSION

_LOG_LINES = 40


def error_in_the_scene(error: Exception) -> RequestError:
    """The error of a result that could not enter the scene; an exception may have an attribute `kind`."""
    return RequestError(sentence(error), "", str(getattr(error, "kind", "scene")))


def defect_in_the_scene(error: Exception) -> RequestError:
    """As `error_in_the_scene`, of an unexpected exception that is being handled: with its traceback."""
    trace = tuple(traceback.format_exc().splitlines())
    return RequestError(f"the result could not be put into the scene: {sentence(error)}", "", "scene", trace)


def error_log() -> Path:
    """The file that `write_error_log` writes."""
    return Path(bpy.app.tempdir or tempfile.gettempdir()) / "primdiffusion_error.txt"


def write_error_log(job: str, error: RequestError, backend: Mapping[str, Any], log: Sequence[str]) -> None:
    """Write what a bug report needs: versions, device, the error, and the end of the backend's `log`.

    `backend` is what the child has reported about itself. The home folder is written as "~".
    """
    lines = [
        f"PrimDiffusion {_version()} ({'extension' if EXTENSION.startswith('bl_ext.') else 'from source'})",
        f"Blender {bpy.app.version_string} ({bpy.app.build_hash.decode(errors='replace')})",
        f"System {platform.platform()}, {platform.machine()}, {os.cpu_count()} processors",
        f"Backend {backend.get('version', 'not started')}, Python {backend.get('python', '?')}, "
        f"torch {backend.get('torch', '?')}, device {backend.get('device_name', '?')}",
        f"{job} ({error.kind}): {error_text(error)}",
        *(f"    {line}" for line in (error.log or log)[-_LOG_LINES:]),
    ]
    with contextlib.suppress(OSError):  # the disk may be full
        error_log().write_text("\n".join(lines).replace(str(Path.home()), "~"), encoding="utf-8")


def _version() -> str:
    manifest = Path(__file__).resolve().parents[1] / "blender_manifest.toml"
    with open(manifest, "rb") as file:
        return tomllib.load(file)["version"]
