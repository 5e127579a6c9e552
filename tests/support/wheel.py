"""The archives for PyPI, built from a copy of the sources."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BACKEND = ROOT / "backend"


def sources() -> set[str]:
    """The package's files by their names in the wheel."""
    return {
        path.relative_to(BACKEND).as_posix()
        for path in (BACKEND / "primdiffusion").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in {".nbi", ".nbc", ".pyc", ".part"}
    }


def build_archives(folder: Path) -> Path:
    """Build wheel and source archive in `folder`/dist, as pip does, without an environment of its own."""
    copy, out = folder / "sources", folder / "dist"
    copy.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in ("README.md", *sources()):
        (copy / "backend" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(BACKEND / name, copy / "backend" / name)
    script = (
        "import sys; from setuptools import build_meta; out = sys.argv[1]; "
        "build_meta.build_wheel(out); build_meta.build_sdist(out)"
    )
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-c", script, str(out)]
    done = subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, text=True, timeout=300, check=False, encoding="utf-8"
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return out
