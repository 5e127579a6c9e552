"""The wheel and the source archive for PyPI: complete, with valid metadata."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata

ROOT = Path(__file__).resolve().parents[2]
BACKEND = ROOT / "backend"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LARGEST_ON_PYPI = 100_000_000
"""Bytes of a file on PyPI, unless more is asked for."""


def sources() -> set[str]:
    """The package's files by their names in the wheel."""
    return {
        path.relative_to(BACKEND).as_posix()
        for path in (BACKEND / "primdiffusion").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in {".nbi", ".nbc", ".pyc", ".part"}
    }


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with both archives, built from a copy of the sources as pip does, without its own environment."""
    folder = tmp_path_factory.mktemp("sources")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    for name in ("README.md", *sources()):
        (folder / "backend" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(BACKEND / name, folder / "backend" / name)
    script = (
        "import sys; from setuptools import build_meta; out = sys.argv[1]; "
        "build_meta.build_wheel(out); build_meta.build_sdist(out)"
    )
    command = [sys.executable, "-c", script, str(tmp_path_factory.mktemp("dist"))]
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return Path(command[-1])


@pytest.fixture(scope="module")
def wheel(built):
    (path,) = built.glob("*.whl")
    assert path.stat().st_size < LARGEST_ON_PYPI
    with zipfile.ZipFile(path) as archive:
        yield archive


def test_the_wheel_holds_the_whole_package_and_nothing_else(wheel):
    names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == sources()
    wanted = {
        "weights/default.safetensors",
        "weights/encoder.safetensors",
        "weights/pose_depth.safetensors",
        "py.typed",
    }
    wanted |= {"body/data/body.npz", "human.py"}
    assert {f"primdiffusion/{name}" for name in wanted} <= names


def test_the_source_archive_holds_what_the_wheel_is_built_from(built):
    (path,) = built.glob("*.tar.gz")
    assert path.stat().st_size < LARGEST_ON_PYPI
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {f"backend/{name}" for name in sources()} | {"pyproject.toml", "LICENSE", "backend/README.md"} <= names
    assert not [name for name in names if name.startswith(("tests", "docs", "blender"))]


def test_the_metadata_are_valid(wheel):
    (name,) = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    metadata = Metadata.from_email(wheel.read(name), validate=True)
    assert (metadata.name, str(metadata.version)) == ("primdiffusion", PROJECT["version"])
    assert (metadata.license_expression, metadata.license_files) == ("GPL-3.0-or-later", ["LICENSE"])
    assert str(metadata.requires_python) == ">=3.11"
    assert metadata.description_content_type == "text/markdown"
    assert "primdiffusion generate" in (metadata.description or "")
    (points,) = [name for name in wheel.namelist() if name.endswith("entry_points.txt")]
    assert b"primdiffusion = primdiffusion.cli:main" in wheel.read(points)


def test_the_page_on_pypi_has_no_links_into_the_repository():
    targets = re.findall(r"\]\(([^)]*)\)", (ROOT / PROJECT["readme"]).read_text(encoding="utf-8"))
    assert not [target for target in targets if not target.startswith("https://")]
