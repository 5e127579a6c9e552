"""Find damaged files in captures, and remove them so that the next run renders only what is missing.

The extension cannot import the backend and has its own module; both use `formats.capture_layout` to detect damage.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from primdiffusion.formats import capture_layout


@dataclasses.dataclass(frozen=True)
class Finding:
    """A problem with a file or a subject."""

    path: Path
    what: str

    def __str__(self) -> str:
        return f"{self.path}: {self.what}"


def verify(root: Path, *, checksums: bool = True) -> list[Finding]:
    """List the problems of a dataset. Without `checksums`, only file sizes are compared.

    Raises:
        CaptureFolderError: the folder contains no captures in our layout.
    """
    capture_layout.read_about(root)
    findings = []
    for subject in subject_folders(root):
        damage = capture_layout.damage(subject, checksums=checksums)
        findings += [Finding(path, what) for path, what in damage.items()]
        findings += [Finding(path, "left behind by a killed process") for path in _leftovers(subject)]
    listed = root / capture_layout.LIST_FILE
    names = listed.read_text(encoding="utf-8", errors="replace").split() if listed.is_file() else []
    there = [path.name for path in subject_folders(root) if (path / capture_layout.COMPLETE_FILE).is_file()]
    if sorted(names) != sorted(there):
        findings.append(Finding(listed, f"lists {len(names)} subjects, but {len(there)} are finished"))
    return findings


def repair(root: Path, findings: list[Finding]) -> None:
    """Remove damaged files, with all passes of their view, and the completion marks of their subjects.

    Rewrites the list. The command that rendered the dataset renders the removed files again. Raises OSError.
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
    """Folders of subjects, finished or not."""
    marks = ("cameras.json", capture_layout.COMPLETE_FILE)
    return sorted(
        path
        for path in root.iterdir()
        if path.is_dir() and not path.name.startswith(".") and any((path / mark).exists() for mark in marks)
    )


def _leftovers(subject: Path) -> list[Path]:
    return sorted(path for path in subject.rglob(".*") if ".partial" in path.name)


def _of_the_same_view(subject: Path, path: Path) -> list[Path]:
    """The file and, for an image, the other passes: img marks a view as complete, so it is removed with any of them."""
    parts = path.relative_to(subject).parts
    if len(parts) != 3 or parts[0] not in capture_layout.ENDINGS or path.name.startswith("."):
        return [path]
    return [subject / kind / parts[1] / f"{path.stem}{ending}" for kind, ending in capture_layout.ENDINGS.items()]
