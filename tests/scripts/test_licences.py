"""docs/licences.md lists every locked package, and no licence that was not considered."""

import importlib.metadata
import pathlib
import sys

import pytest

from scripts.asset_licences import licence_of

SCRIPT = pathlib.Path(__file__).parents[2] / "scripts/licences"
sys.path.append(str(SCRIPT))

import licences  # noqa: E402


def rows() -> dict[str, list[str]]:
    lines = licences.PAGE.read_text(encoding="utf-8").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    return {name: rest for name, *rest in cells[1:]}


def test_the_page_is_what_its_script_writes_now():
    current = licences.PAGE.read_text(encoding="utf-8") == licences.page()
    assert current, "docs/licences.md is out of date: run `python scripts/licences`"


def test_every_locked_package_is_listed_in_its_versions_and_no_other_one():
    pins = {name: ", ".join(sorted(versions)) for name, (versions, _) in licences.locked().items()}
    assert {"bpy", "numpy", "colorama", "cattrs", "nvidia-cudnn-cu13"} <= pins.keys()
    assert {name: cells[0] for name, cells in rows().items()} == pins


def test_no_licence_is_unknown_or_restricted_but_the_named_exceptions():
    assert not [(name, cells[1]) for name, cells in rows().items() if licences.rejected(name, cells[1])]


@pytest.mark.parametrize(
    ("name", "licence", "rejected"),
    [
        ("one", "MIT", False),
        ("one", "AGPL-3.0-only OR MIT", False),
        ("one", "AGPL-3.0-only AND MIT", True),
        ("one", "Apache-2.0 WITH LLVM-exception", False),
        ("one", "unknown", True),
        ("cuda-toolkit", "unknown", False),
        ("one", "LicenseRef-SMPL-X", True),
    ],
)
def test_a_licence_outside_the_list_is_rejected(name, licence, rejected):
    assert licences.rejected(name, licence) == rejected


@pytest.mark.parametrize(
    ("metadata", "text", "licence"),
    [
        ("License-Expression: MIT AND CNRI-Python", "", "MIT AND CNRI-Python"),
        ("License: Apache 2.0", "", "Apache-2.0"),
        ("Classifier: License :: OSI Approved :: MIT License", "", "MIT"),
        ("License: BSD", "Redistribution and use ... Neither the name of X. Bundled: MIT License", "BSD-3-Clause"),
        ("License: BSD", "Redistribution and use in source", "BSD-2-Clause"),
        ("License: Our own", "All rights reserved", "unknown"),
    ],
)
def test_the_licence_of_a_package_is_what_its_metadata_state(tmp_path, metadata, text, licence):
    folder = tmp_path / "one-1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: one\nVersion: 1\n{metadata}\n")
    (folder / "LICENSE").write_text(text)
    (folder / "RECORD").write_text("one-1.dist-info/LICENSE,,\n")
    assert licences.stated_licence(importlib.metadata.PathDistribution(folder)) == licence


def test_licences_are_read_from_headers_lists_and_materials(tmp_path):
    (tmp_path / "pack/hat").mkdir(parents=True)
    root = tmp_path / "pack"
    (root / "hat/a.obj").write_text("# This asset was explicitly released as CC0 in september 2020.\nv 0 0 0\n")
    (root / "hat/b.mhclo").write_text("# license CC-BY-SA 4.0\n")
    (root / "hat/c.obj").write_text("v 0 0 0\n# CC0\n")
    (root / "hat/d.mhmat").write_text("# released as CC0\ndiffuseTexture d_diffuse.png\n")
    for name in ("d_diffuse.png", "e.png", "f.png"):
        (root / "hat" / name).write_bytes(b"")
    (tmp_path / "LICENSES.txt").write_text("Notes\npath | source | license\npack/hat/e.png | x | CC-BY-4.0 | y\n")
    found = {name: licence_of(root, f"hat/{name}") for name in ("a.obj", "b.mhclo", "d_diffuse.png", "e.png", "f.png")}
    assert found == {
        "a.obj": "CC0-1.0",
        "b.mhclo": "CC-BY-SA 4.0",
        "d_diffuse.png": "CC0-1.0",
        "e.png": "CC-BY-4.0",
        "f.png": "unknown",
    }
