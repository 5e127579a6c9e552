"""`python -m blender_primdiffusion generate | render | capture ...`, with Blender as a Python module."""

from __future__ import annotations

import sys

from . import register, unregister
from .capture.launch import leave
from .ui.batch import execute

if __name__ == "__main__":
    register()
    try:
        code = execute(sys.argv[1:])
    finally:
        unregister()
    leave(code)
