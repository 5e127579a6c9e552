"""Writes docs/licences.md, the licences of all locked packages: `python scripts/licences`.

Run it in an environment made by `make setup`: licences are read from the metadata of installed packages.
"""

from __future__ import annotations

import argparse
import sys

from licences import PAGE, page


def main() -> int:
    """Write the page; with --check only report whether it is up to date."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if the page is out of date")
    arguments = parser.parse_args()
    text = page()
    if arguments.check:
        return int(not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != text)
    PAGE.write_text(text, encoding="utf-8", newline="\n")
    print(PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
