"""Finding damage in captures, and clearing it away so that rendering again makes just what is missing.

The extension, which imports nothing of the backend, has a module of its own; `layout` tells both what damage is.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from primdiffusion.formats import capture_layout


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something wrong with a file, or with a whole subject."""

    path: Path
    what: str

    def __str__(self) -> str:
        return f"{self.path}: {self.what}"


def verify(root: Path, *, checksums: bool = True) -> list[Finding]:
    """Everything wrong with the captures of a folder; empty where nothing is. Without `checksums` only sizes count.

    Raises:
        CaptureFolderError: it holds no captures of our capture_layout.
    """
    capture_layout.read_about(root)
    findings = []
    for subject in subject_folders(root):
        damage = capture_layout.damage(subject, checksums=checksums)
        findings += [Finding(path, what) for path, what in damage.items()]
        findings += [Finding(path, "left by a killed process") for path in _leftovers(subject)]
    listed = root / capture_layout.LIST_FILE
    names = listed.read_text(encoding="utf-8", errors="replace").split() if listed.is_file() else []
    there = [path.name for path in subject_folders(root) if (path / capture_layout.COMPLETE_FILE).is_file()]
    if sorted(names) != sorted(there):
        findings.append(Finding(listed, f"names {len(names)} subjects, finished are {len(there)}"))
    return findings


def repair(root: Path, findings: list[Finding]) -> None:
    """Remove what is damaged, all passes of a view together, and the completion marks of the subjects it belongs to.

    The list is written anew. What was removed is made again by the command that rendered it. Raises OSError.
    """
    for finding in findings:
        if finding.path.is_dir() or finding.path == root / capture_layout.LIST_FILE:
            continue
        subject = root / finding.path.relative_to(root).parts[0]
        for path in _of_the_same_view(subject, finding.path):
            path.unlink(missing_ok=True)
        if not finding.path.name.startswith("."):
            (subject / capture_layout.COMPLETE_FILE).unlink(missing_ok=True)
    capture_layout.write_list(
        root, [path.name for path in subject_folders(root) if (path / capture_layout.COMPLETE_FILE).is_file()]
    )


def subject_folders(root: Path) -> list[Path]:
    """Folders that a renderer began, finished or not."""
    marks = ("cameras.json", capture_layout.COMPLETE_FILE)
    return sorted(
        path
        for path in root.iterdir()
        if path.is_dir() and not path.name.startswith(".") and any((path / mark).exists() for mark in marks)
    )


def _leftovers(subject: Path) -> list[Path]:
    return sorted(path for path in subject.rglob(".*") if ".partial" in path.name)


def _of_the_same_view(subject: Path, path: Path) -> list[Path]:
    """The file and, of a picture, the other passes: the img tells that a view is done, so it goes with any of them."""
    parts = path.relative_to(subject).parts
    if len(parts) != 3 or parts[0] not in capture_layout.ENDINGS or path.name.startswith("."):
        return [path]
    return [subject / kind / parts[1] / f"{path.stem}{ending}" for kind, ending in capture_layout.ENDINGS.items()]
