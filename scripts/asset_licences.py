"""List the licences of the asset files from which `primdiffusion people` makes humans.

    python -m scripts.asset_licences --assets DIR

Text files (.mhclo, .obj, .mhmat) begin with comments that state their licence. Images are listed in a LICENSES.txt in
or above the folder (a table `path | ... | licence | ...`), or referenced by a material in the same folder that states
its own.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

import tyro
from primdiffusion.files.regular_files import open_regular, read_regular
from primdiffusion.people.assets import SUBFOLDERS, open_assets

UNKNOWN = "unknown"
LIST = "LICENSES.txt"
LEVELS = 3
"""Number of folders searched for a list: the asset folder and its parents."""
HEADER_BYTES = 4096
LARGEST_LIST = 32 * 2**20
"""Bytes."""
STATED = (
    (re.compile(r"\b(?:released as|licen[cs]ed? (?:under|is|:)?)\s*\W{0,3}(?:CC0\b|CC-0\b)", re.IGNORECASE), "CC0-1.0"),
    (re.compile(r"\bCC[- ]?BY(?:[- ](?:SA|NC|ND))*(?:[- ]\d\.\d)?", re.IGNORECASE), ""),
    (re.compile(r"\bA?GPL[- ]?v?\d(?:\.\d)?", re.IGNORECASE), ""),
    (re.compile(r"\bCC0\b"), "CC0-1.0"),
)
"""Patterns of licence statements and the licences' names; an empty name stands for the matched text."""


def licence_of(root: Path, path: str) -> str:
    """Return the licence of an asset file, "unknown" if none is stated.

    Args:
        root: the asset folder.
        path: path relative to it, with "/".
    """
    listed = _listed(root)
    if path in listed:
        return listed[path]
    file = root / path
    if file.suffix in (".mhclo", ".obj", ".mhmat"):
        return _stated(file)
    # The image may have been converted to another format since the material was written.
    named = re.compile(rf"(?<![\w-]){re.escape(file.stem)}\.\w+")
    for material in sorted(file.parent.glob("*.mhmat")):
        if named.search(_head(material)):
            return _stated(material)
    return UNKNOWN


@functools.lru_cache(maxsize=4)
def _listed(root: Path) -> dict[str, str]:
    """Licences by relative path, from the lists in and above the asset folder; the nearest list takes precedence."""
    licences: dict[str, str] = {}
    for folder in reversed((root, *root.parents)[:LEVELS]):
        if (folder / LIST).is_file():
            for path, licence in _table(read_regular(folder / LIST, LARGEST_LIST).decode("utf-8", "replace")).items():
                for start in (folder, root):
                    if (start / path).is_relative_to(root):
                        licences[(start / path).relative_to(root).as_posix()] = licence
    return licences


def _table(text: str) -> dict[str, str]:
    """Parse the columns "path" and "licence" of a table with a header row and cells separated by "|"."""
    licences: dict[str, str] = {}
    columns: list[str] = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) < 2:
            continue
        if not columns:
            names = [cell.lower().replace("license", "licence") for cell in cells]
            columns = names if {"path", "licence"} <= set(names) else []
        elif len(cells) >= len(columns):
            licences[cells[columns.index("path")]] = cells[columns.index("licence")].split(" (")[0]
    return licences


@functools.lru_cache(maxsize=1024)
def _stated(file: Path) -> str:
    """The licence stated in a text file's opening comments."""
    comments = " ".join(line.lstrip("# ") for line in _head(file).splitlines() if line.startswith("#"))
    for pattern, name in STATED:
        found = pattern.search(comments)
        if found:
            return name or found[0]
    return UNKNOWN


@functools.lru_cache(maxsize=1024)
def _head(file: Path) -> str:
    try:
        with open_regular(file, 2**62) as stream:
            return stream.read(HEADER_BYTES).decode("utf-8", errors="replace")
    except OSError:
        return ""


def main(assets: Path | None = None) -> None:
    """Print a line for each mesh, proxy and image: its licence, and its path in the asset folder."""
    root = open_assets(assets).root
    for path in sorted(path for folder in SUBFOLDERS for path in (root / folder).rglob("*.*")):
        if path.suffix in (".mhclo", ".obj", ".png", ".jpg"):
            name = path.relative_to(root).as_posix()
            print(f"{licence_of(root, name):<12} {name}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
