"""The command `capture` with Blender as a Python module, and in a Blender of its own where the extension need not be
enabled: `python -m blender_primdiffusion.capture ...`, `blender -b --factory-startup --python __main__.py -- ...`."""

from __future__ import annotations

import importlib
import importlib.util
import os
import shutil
import sys
from pathlib import Path
from typing import NoReturn

import bpy

_NAME = "primdiffusion_extension"


def run_command() -> int:
    """The command with the arguments after `--`, of the extension that this file is in."""
    root = Path(__file__).resolve().parents[1]
    spec = importlib.util.spec_from_file_location(_NAME, root / "__init__.py", submodule_search_locations=[str(root)])
    package = importlib.util.module_from_spec(spec)
    sys.modules[_NAME] = package
    spec.loader.exec_module(package)
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    return importlib.import_module(f"{_NAME}.capture.command").main(words)


def leave(code: int) -> NoReturn:
    """End the process without Blender's own end, which may wait for a thread that reads stdin."""
    sys.stdout.flush()
    sys.stderr.flush()
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    os._exit(code)


if __name__ == "__main__" and __package__:
    from .command import main

    sys.exit(main(sys.argv[1:]))
elif __name__ == "__main__":
    leave(run_command())
