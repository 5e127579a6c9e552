"""Errors of jobs, and the button that helps."""

from __future__ import annotations

import dataclasses
import errno
import re
import traceback

import bpy

from ..backend.requests import RequestError, sentence
from ..places import INSTALLS_BACKEND

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)


@dataclasses.dataclass(frozen=True)
class Remedy:
    """A button."""

    operator: str
    label: str
    icon: str


_TRY_AGAIN = Remedy("primdiffusion.try_again", "Try Again", "FILE_REFRESH")
_PREFERENCES = Remedy("preferences.addon_show", "Open Preferences", "PREFERENCES")
_SAVE_AS = Remedy("wm.save_as_mainfile", "Save As...", "FILE_TICK")
_REMEDIES = {
    "environment": Remedy("primdiffusion.set_up_backend", "Set Up Backend", "IMPORT")
    if INSTALLS_BACKEND
    else _PREFERENCES,
    "out_of_memory": Remedy("primdiffusion.release_memory", "Release Memory", "MEMORY"),
    "missing_file": _PREFERENCES,  # a checkpoint's path
    "unwritable": _SAVE_AS,
    "file_system": _SAVE_AS,
    "busy": _TRY_AGAIN,
    "timeout": _TRY_AGAIN,
    "died": _TRY_AGAIN,
    "hung": _TRY_AGAIN,
}
"""By the kind of error."""
_OF_PREFERENCES = re.compile("checkpoint|encoder|safetensors")
"""Other missing files, such as captures, are chosen in their panels."""


def remedy_for(error: RequestError) -> Remedy | None:
    """The button for an error, if any that this Blender has."""
    remedy = _REMEDIES.get(error.kind)
    if remedy is None or (error.kind == "missing_file" and not _OF_PREFERENCES.search(error.message)):
        return None
    room, name = remedy.operator.split(".")
    try:
        getattr(getattr(bpy.ops, room), name).get_rna_type()
    except KeyError:
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


def error_before_the_scene(message: str) -> RequestError:
    """The error of a result that could not begin to enter the scene."""
    return RequestError(message, "", "scene")
