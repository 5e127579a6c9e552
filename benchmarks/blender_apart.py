"""Blender as a module apart from the user's own: settings and temporary files of this process alone, removed with it.

Import it before bpy. They are removed when Python exits; a program that leaves by `os._exit` calls `remove` itself.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile

_FOLDER = tempfile.mkdtemp(prefix="primdiffusion_benchmark_")
os.environ["BLENDER_USER_RESOURCES"] = _FOLDER


def remove() -> None:
    bpy = sys.modules.get("bpy")
    if bpy is not None:
        shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    shutil.rmtree(_FOLDER, ignore_errors=True)


atexit.register(remove)
