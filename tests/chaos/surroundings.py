"""Odd environments: a HOME that cannot be written to, a TMPDIR that is gone, strange modules in PYTHONPATH."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from chaos.forks import FOLDERS, Ended
from chaos.full_disk import complaints
from chaos.kills import Tally

NOWHERE = "/dev/null/nowhere"
STRANGE = ("cli", "commands", "formats", "human", "serve", "staging", "machine", "failures", "config", "tests", "utils")
"""Modules of other programs that have the names of ours, and must not be imported."""
BROKEN = "numpy"
"""A package built for another Python, which cannot be imported: one sentence says so."""
HOMES = ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "NUMBA_CACHE_DIR")


def odd_environments(folder: Path) -> dict[str, dict[str, str]]:
    """Environment variables by what is odd about them; modules are written to `folder`."""
    for name in STRANGE:
        (folder / "strange").mkdir(exist_ok=True)
        (folder / "strange" / f"{name}.py").write_text("raise RuntimeError('the wrong module')\n")
    return {
        "unwritable HOME": dict.fromkeys(HOMES[:3], NOWHERE),
        "TMPDIR is gone": {"TMPDIR": NOWHERE, "TEMP": NOWHERE, "TMP": NOWHERE},
        "strange PYTHONPATH": {"PYTHONPATH": str(folder / "strange")},
    }


def broken_environment(folder: Path) -> dict[str, str]:
    """A PYTHONPATH with a numpy that cannot be imported."""
    (folder / "broken" / BROKEN).mkdir(parents=True, exist_ok=True)
    (folder / "broken" / BROKEN / "__init__.py").write_text("raise ImportError('built for another Python')\n")
    return {"PYTHONPATH": str(folder / "broken")}


def entry_commands(checkpoint: Path, human: Path, out: Path) -> dict[str, Sequence[str | Path]]:
    """Command lines of a process each, by name."""
    sampled = ["--checkpoint", checkpoint, "--steps", "1", "--size", "16"]
    module = [sys.executable, "-m", "primdiffusion"]
    return {
        "help": [*module, "--help"],
        "info": [*module, "info"],
        "generate": [*module, "generate", *sampled, "--out", out / "g"],
        "render": [*module, "render", human, "--size", "16", "--out", out / "r.png"],
        "serve": [sys.executable, "-m", "primdiffusion.serve"],
    }


def run(command: Sequence[str | Path], environment: Mapping[str, str]) -> Ended:
    """Run an entry command, whose input ends at once."""
    path = os.pathsep.join([environment["PYTHONPATH"]] if "PYTHONPATH" in environment else [])
    paths = os.pathsep.join([path, *map(str, FOLDERS[:2])]).strip(os.pathsep)
    done = subprocess.run(
        list(map(str, command)),
        env={**os.environ, **environment, "PYTHONPATH": paths},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return Ended(done.returncode, done.stderr, 0.0, 0)


def try_environments(
    commands: Mapping[str, Sequence[str | Path]], environments: Mapping[str, Mapping[str, str]], tally: Tally
) -> None:
    """Each command in each environment must work."""
    for oddity, environment in environments.items():
        for name, command in commands.items():
            ended = run(command, environment)
            wrong = [f"exit code {ended.exit_code}: {ended.log[-400:]}"] if ended.exit_code else []
            tally.add(1, wrong, f"{name}, {oddity}")


def try_broken(commands: Mapping[str, Sequence[str | Path]], environment: Mapping[str, str], tally: Tally) -> None:
    """Each command must say in one sentence what cannot be loaded."""
    for name, command in commands.items():
        ended = run(command, environment)
        wrong = complaints(ended) if ended.exit_code else []
        tally.add(1, wrong, f"{name}, broken {BROKEN}")
