"""What can be done about an error: one sentence, and a button that does it."""

from __future__ import annotations

import dataclasses
import errno
import re
from typing import TYPE_CHECKING

import bpy

from ..worker.sentence import sentence

if TYPE_CHECKING:
    from ..worker.request import RequestError

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)


@dataclasses.dataclass(frozen=True)
class Remedy:
    """A button."""

    operator: str
    label: str
    icon: str


_TRY_AGAIN = Remedy("primdiffusion.try_again", "Try Again", "FILE_REFRESH")
_SAVE_AS = Remedy("wm.save_as_mainfile", "Save As...", "FILE_TICK")
_REMEDIES = {
    "environment": Remedy("primdiffusion.set_up_backend", "Set Up Backend", "IMPORT"),
    "missing_volumes": Remedy("primdiffusion.find_missing_volumes", "Find Missing Volumes", "VIEWZOOM"),
    "out_of_memory": Remedy("primdiffusion.release_memory", "Release Memory", "MEMORY"),
    "missing_file": Remedy("preferences.addon_show", "Open Preferences", "PREFERENCES"),  # a checkpoint's path
    "unwritable": _SAVE_AS,
    "file_system": _SAVE_AS,
    "busy": _TRY_AGAIN,
    "died": _TRY_AGAIN,
    "hung": _TRY_AGAIN,
}
"""By the kind of the error."""
_OF_PREFERENCES = re.compile("checkpoint|encoder|safetensors")
"""A missing folder of captures is chosen in its panel."""


def remedy_for(error: RequestError) -> Remedy | None:
    """The button for an error; None where the sentence must do, or this version has no such button."""
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
    """Why a result is not in the scene; an exception may name its kind itself, in an attribute `kind`."""
    from ..worker.request import RequestError

    kind = getattr(error, "kind", "scene")
    cause = error if isinstance(error, OSError) else error.__cause__
    while cause is not None and not getattr(cause, "errno", None):
        cause = cause.__cause__
    if cause is not None and cause.errno in _NO_ROOM:
        return RequestError(
            sentence(error), "Save the file where there is room and you may write, then try again", "unwritable"
        )
    return RequestError(sentence(error), "", str(kind))


def defect_in_the_scene(error: Exception) -> RequestError:
    """As `error_in_the_scene`, of an exception that is being handled and that nobody foresaw: with its traceback."""
    import traceback

    from ..worker.request import RequestError

    trace = tuple(traceback.format_exc().splitlines())
    return RequestError(f"the result could not be put into the scene: {sentence(error)}", "", "scene", trace)


def refusal_of_the_scene(message: str) -> RequestError:
    """Why a result could not even begin to enter the scene."""
    from ..worker.request import RequestError

    return RequestError(message, "", "scene")
