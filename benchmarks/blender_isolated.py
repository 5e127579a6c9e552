"""Run Blender as a module without touching the user's settings: private settings and temporary files.

Import this before bpy, as its name sorts among imports. The files are removed when Python exits; a program that exits
by `os._exit` calls `remove`.
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
