"""`python -m blender_primdiffusion.capture ...`, with Blender as a Python module."""

from __future__ import annotations

import sys

from .command import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
