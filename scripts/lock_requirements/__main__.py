"""Lock the backend's requirements for the extension: `python scripts/lock_requirements` (needs uv and a network).

For every target in targets.py, uv resolves pyproject.toml's dependencies with the versions of requirements.lock; each
package becomes a line with the SHA-256 of the one wheel that the target uses. If download.pytorch.org cannot be
reached, pytorch_wheels.json describes its wheels.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import tomllib

from targets import TARGETS, Target
from wheels import NoWheel, Wheel, wheel_of

ROOT = pathlib.Path(__file__).parents[2]
OUT = ROOT / "blender_primdiffusion/requirements"
_OF_CUDA = re.compile(r"(?:nvidia|cuda)-.*|triton")
_OWN_OF_PYTHON = {"3.13": ("numpy",), "3.14": ("numpy",)}
"""Packages whose locked version has no wheel for that Python: the newest version that the others allow is used."""


def main() -> None:
    """Write a lock for each target; report targets that cannot be locked at the end, and delete their old files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=OUT, help="folder for the locks")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    missing = []
    for target in TARGETS:
        path = out / f"{target.name}.txt"
        try:
            text, summary = locked(target)
        except NoWheel as error:
            path.unlink(missing_ok=True)
            missing.append(f"{target.name}: {error}")
            continue
        path.write_text(text, encoding="utf-8", newline="\n")
        print(summary)
    for line in missing:
        print(f"not locked: {line}", file=sys.stderr)


def locked(target: Target) -> tuple[str, str]:
    """The text of a target's lock, and a one-line summary. Raises NoWheel."""
    wheels = {pin: wheel_of(*pin, target) for pin in resolved(target)}
    indexes = sorted({wheel.index for wheel in wheels.values() if wheel.index})
    lines = [
        "# Made by scripts/lock_requirements from pyproject.toml. Not to be edited.",
        *(f"--extra-index-url {index}" for index in indexes),
        *(_line(name, version, wheel) for (name, version), wheel in wheels.items()),
    ]
    size = sum(wheel.bytes for wheel in wheels.values())
    known = all(wheel.installed is not None for wheel in wheels.values())
    installed = sum(wheel.installed or 0 for wheel in wheels.values())
    summary = f"{target.name}: {len(wheels)} packages, {size / 1e6:.0f} MB"
    summary += f", {installed / 1e6:.0f} MB installed{'' if known else ' (torch unknown)'}"
    return "\n".join(lines) + "\n", summary


def resolved(target: Target) -> list[tuple[str, str]]:
    """Names and versions of all packages of a target, by name. Raises CalledProcessError with uv's output on stderr."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pins = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    free = _OWN_OF_PYTHON.get(target.python, ())
    with tempfile.TemporaryDirectory() as folder:
        requirements, constraints = pathlib.Path(folder, "requirements.in"), pathlib.Path(folder, "constraints.txt")
        requirements.write_text("\n".join(project["dependencies"]), encoding="utf-8")
        constraints.write_text("\n".join(line for line in pins if line.split("==")[0] not in free), encoding="utf-8")
        command = ["uv", "pip", "compile", str(requirements), "-c", str(constraints), "--quiet", "--no-config"]
        command += ["--python-version", target.python, "--python-platform", target.uv_platform]
        command += ["--only-binary", ":all:", "--no-header", "--no-annotate"]
        environment = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0"}  # torch has no wheels for older ones
        text = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=environment, encoding="utf-8"
        ).stdout
    found = re.findall(r"^([a-z0-9-]+)==(\S+)$", text, re.MULTILINE)
    return sorted(pin for pin in found if not (target.without_cuda and _OF_CUDA.fullmatch(pin[0])))


def _line(name: str, version: str, wheel: Wheel) -> str:
    if wheel.index:
        version = wheel.filename.split("-")[1]
    installed = "?" if wheel.installed is None else str(wheel.installed)
    return f"{name}=={version} --hash=sha256:{wheel.sha256}  # {wheel.bytes} bytes, {installed} installed"


if __name__ == "__main__":
    main()
