"""Writes docs/manual/api.md from the registered operators and settings: `python scripts/operators_page`.

Needs `bpy`. The page contains everything that is registered, with its own descriptions, defaults and docstrings.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "manual" / "api.md"


def main() -> int:
    """Write the page; with --check only report whether it is up to date."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if the page is out of date")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    import page

    import blender_primdiffusion

    blender_primdiffusion.register()
    text = page.page()
    blender_primdiffusion.unregister()
    if arguments.check:
        return int(not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != text)
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    PAGE.write_text(text, encoding="utf-8")
    print(PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
