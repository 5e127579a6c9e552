"""The wheel and the source archive for PyPI: complete, with valid metadata."""

import re
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata
from support.wheel import ROOT, build_archives, sources

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LARGEST_ON_PYPI = 100 * 2**20
"""Bytes of a file on PyPI, unless more is asked for."""


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with both archives."""
    return build_archives(tmp_path_factory.mktemp("archives"))


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
