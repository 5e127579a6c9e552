"""Measures how long `make test` takes on each Blender.

    python benchmarks/suite.py --json docs/results/suite.json

Run it on an idle machine after `make test` has set up the environments. Ends with an error if a test fails.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import record

ROOT = Path(__file__).resolve().parents[1]
BLENDERS = ("5.0", "4.5", "5.2")


def main() -> None:
    parser = record.command_line(__doc__)
    arguments = parser.parse_args()
    figures: dict[str, float | None] = {}
    for version in BLENDERS:
        with record.measured() as took:
            subprocess.run(["make", f"test-{version}"], cwd=ROOT, check=True)
        figures[f"test_minutes_{version.replace('.', '_')}"] = took.seconds / 60
    total = sum(minutes for minutes in figures.values() if minutes is not None)
    record.report({"test_minutes": total, **figures}, arguments.json)


if __name__ == "__main__":
    main()
