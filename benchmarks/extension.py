"""Figures of the extension: registration, building, frames, motion, memory, both attachments, Cycles, a soak test.

    python benchmarks/extension.py --json docs/results/extension.json
    python benchmarks/extension.py --also 4_5=.venv45/bin/python --json ...     # the same on another bpy: names + _4_5

Each part runs in its own process; the real child generates. `--quick` renders smaller pictures and soaks for five
rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import record

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
REGISTRATIONS = 7
PARTS = ["register", "person", "memory", "merged", "soak", "bare"]


def main() -> None:
    """Measure with this interpreter, then with those of --also."""
    parser = record.command_line(__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller pictures, five rounds")
    parser.add_argument("--parts", nargs="*", default=PARTS, help="parts to measure; the file's other figures stay")
    parser.add_argument(
        "--also",
        nargs="*",
        default=[f"4_5={ROOT / '.venv45/bin/python'}"] if (ROOT / ".venv45/bin/python").exists() else [],
        help="NAME=PYTHON of other versions of bpy",
    )
    arguments = parser.parse_args()
    figures = measure(Path(sys.executable), arguments)
    for other in arguments.also:
        name, _, python = other.partition("=")
        figures |= {f"{key}_{name}": value for key, value in measure(Path(python), arguments).items()}
    if arguments.json is not None and arguments.json.exists() and set(arguments.parts) != set(PARTS):
        about = record.surroundings()
        before = json.loads(arguments.json.read_text())
        figures = {name: value for name, value in before.items() if name not in about} | figures
    record.report(figures, arguments.json)


def measure(python: Path, arguments: argparse.Namespace) -> dict[str, float | str | None]:
    """Figures of the chosen parts on one version of bpy."""
    with tempfile.TemporaryDirectory(prefix="primdiffusion_extension_") as name:
        folder = Path(name)
        command = [sys.executable, "-m", "primdiffusion", "generate", "--seed", "7", "--out", str(folder / "person")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        found: dict[str, float | str | None] = {"bpy": version(python)}
        if "register" in arguments.parts:
            times = [run(python, "register", folder)["register_ms"] for _ in range(REGISTRATIONS)]
            found["register_ms"] = min(times)  # the minimum: other programs only add time
        options = (
            {"merged": ["--size", "128"], "soak": ["--rounds", "5"], "bare": ["--rounds", "5"]}
            if arguments.quick
            else {}
        )
        for part in ("person", "memory", "merged", "soak", "bare"):
            if part in arguments.parts:
                found |= run(python, part, folder, *options.get(part, []))
        return found


def version(python: Path) -> str:
    command = [str(python), "-c", "import bpy; print('bpy', bpy.app.version_string)"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return next(line.removeprefix("bpy ") for line in lines if line.startswith("bpy "))


def run(python: Path, part: str, folder: Path, *options: str) -> dict[str, float | None]:
    """The figures of one part; ends with the part's output if it fails."""
    command = [str(python), str(HERE / "extension_parts.py"), part, str(folder), *options]
    environment = {**os.environ, "PRIMDIFFUSION_PYTHON": sys.executable}
    print(f"{part} ...", file=sys.stderr, flush=True)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("figures ")]
    if not lines:
        raise SystemExit(f"{part} failed on {python}:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
    return json.loads(lines[-1].removeprefix("figures "))


if __name__ == "__main__":
    main()
