"""Errors of jobs, the button that helps, and the log for a bug report."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import platform
import re
import tempfile
import tomllib
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..backend.requests import RequestError, error_text, sentence
from ..places import EXTENSION, INSTALLS_BACKEND

_LOG_LINES = 40

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)


@dataclasses.dataclass(frozen=True)
class Remedy:
    """A button."""

    operator: str
    label: str
    icon: str
    properties: Mapping[str, str] = dataclasses.field(default_factory=dict)


_PREFERENCES = Remedy("preferences.addon_show", "Open Preferences", "PREFERENCES", {"module": EXTENSION})
_SAVE_AS = Remedy("wm.save_as_mainfile", "Save As...", "FILE_TICK")
_REMEDIES = {
    "environment": Remedy("primdiffusion.set_up_backend", "Set Up Backend", "IMPORT")
    if INSTALLS_BACKEND
    else _PREFERENCES,
    "missing_file": _PREFERENCES,  # a checkpoint's path
    "unwritable": _SAVE_AS,
    "file_system": _SAVE_AS,
}
"""By the kind of error."""
_PREFERENCE_ERRORS = re.compile("checkpoint|safetensors")
"""Other missing files, such as captures, are chosen in their panels."""


def remedy_for(error: RequestError) -> Remedy | None:
    """The button for an error, if there is one; for others, the button that was pressed is the one to press again."""
    remedy = _REMEDIES.get(error.kind)
    if remedy is None or (error.kind == "missing_file" and not _PREFERENCE_ERRORS.search(error.message)):
        return None
    return remedy


def error_in_the_scene(error: Exception) -> RequestError:
    """The error of a result that could not enter the scene; an exception may have an attribute `kind`."""
    kind = getattr(error, "kind", "scene")
    cause = error if isinstance(error, OSError) else error.__cause__
    while cause is not None and not getattr(cause, "errno", None):
        cause = cause.__cause__
    if cause is not None and cause.errno in _DISK_FULL:
        return RequestError(
            sentence(error),
            "Save the file in a folder with free space and write permission, then try again",
            "unwritable",
        )
    return RequestError(sentence(error), "", str(kind))


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
