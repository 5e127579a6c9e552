"""Files and folders that appear whole or not at all, written under temporary names. Needs no numpy.

A temporary name is `.STEM.PID-RANDOM.partial.SUFFIX`. What a killed process left is removed by the next writer to the
same place once nothing of it has changed for a day: whether a process of another machine has ended cannot be asked.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

from .regular_files import check_inside, remove_file, remove_folder

ABANDONED_AFTER_S = 86_400.0
"""Age of a temporary file, seconds, from which its writer counts as ended."""
_TEMPORARY = re.compile(r"\.(?P<stem>.*)\.(?P<pid>[0-9]{1,10})-[0-9a-f]{8}\.partial(?P<suffix>\.[^.]*)?")


def temporary_name(path: Path) -> Path:
    """An unused name beside `path`, to write to."""
    return path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}.partial{path.suffix}")


@contextlib.contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder with a temporary name beside `path`; it is removed after the block. Raises OSError."""
    folder = temporary_name(path)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        remove_folder(folder, folder.parent)


def remove_abandoned(folder: Path, of: Path | None = None, after_s: float = ABANDONED_AFTER_S) -> None:
    """Remove what killed processes left in a folder, only what was to become `of` if given. Raises no OSError.

    Who holds the folder alone (`lock_folder`) knows that no other process writes there: `after_s` is 0 then.
    """
    for path, named in _temporary_files(folder):
        if of is None or (named["stem"], named["suffix"] or "") == (of.stem, of.suffix):
            with contextlib.suppress(OSError):
                inside = list(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
                newest = max(entry.lstat().st_mtime for entry in (path, *inside))
                if time.time() - newest >= after_s:
                    _remove(path)


def remove_of_process(folder: Path, pid: int) -> None:
    """Remove what a process of this machine, which has been killed, left in a folder. Raises no OSError."""
    for path, named in _temporary_files(folder):
        if int(named["pid"]) == pid:
            with contextlib.suppress(OSError):
                _remove(path)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` to write to; it is renamed at the end, or removed after an error.

    A `path` that is such a temporary name is yielded itself. Raises OSError, naming `path`; PermissionError if it is a
    folder or a device, which renaming would replace.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise PermissionError(errno.EPERM, "this is not a regular file and will not be replaced", str(path))
    if _TEMPORARY.fullmatch(path.name):  # its writer renames or removes it
        yield path
        return
    remove_abandoned(path.parent, path)
    unfinished = temporary_name(path)
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as e:  # Python names no file when the disk is full
        if e.errno is None or e.filename not in (None, str(unfinished), unfinished):
            raise
        raise type(e)(e.errno, e.strerror or str(e), str(path)) from e
    finally:
        remove_file(unfinished, unfinished.parent)


@contextlib.contextmanager
def atomic_replace(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """`atomic_path`, after creating the folder of `path`; in `folder`, if given, out of which no link may lead.

    Raises FileError where one does.
    """
    if folder is not None:
        check_inside(path, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as unfinished:
        yield unfinished


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8 with its line ends as they are on every system; creates its folder.

    Raises OSError, naming `path`.
    """
    with atomic_replace(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def atomic_folder(folder: str | Path) -> Iterator[Path]:
    """Yield a temporary folder inside `folder`, to which its files and folders move at the end, replacing those of the
    same names.

    After an error everything is removed, including a newly created `folder`. Raises OSError, naming the file in
    `folder`; at once if it cannot be written to.
    """
    target, made = Path(folder), []
    aside = temporary_name(target / "files")
    try:
        made = _create_folders(target)
        remove_abandoned(target)
        aside.mkdir()
        yield aside
        move_into_place(aside, target)
        made = []
    except OSError as e:
        if isinstance(e.filename, str | Path) and (path := Path(e.filename)).is_relative_to(aside):
            raise type(e)(e.errno, e.strerror, str(target / path.relative_to(aside))) from e
        raise
    finally:
        if target.is_dir():
            remove_folder(aside, target)
        for path in made:
            with contextlib.suppress(OSError):  # in use
                path.rmdir()


def move_into_place(made: Path, folder: Path) -> None:
    """Move the content of a folder into another of the same disk: files replace files, and folders folders.

    Raises OSError; IsADirectoryError or NotADirectoryError, before anything moves, where a folder meets a file.
    """
    pieces = [(path, folder / path.name) for path in sorted(made.iterdir())]
    for path, target in pieces:
        if target.exists() and target.is_dir() != path.is_dir():
            what = "a folder" if target.is_dir() else "not a folder"
            number = errno.EISDIR if target.is_dir() else errno.ENOTDIR  # OSError becomes the class of its number
            raise OSError(number, f"this is {what} and will not be replaced", str(target))
    for path, target in pieces:
        if target.is_dir():
            remove_folder(target, folder)
        os.replace(path, target)


def _create_folders(folder: Path) -> list[Path]:
    """Create `folder` and its missing parents; return the created ones, innermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
    return missing


def _temporary_files(folder: Path) -> list[tuple[Path, re.Match[str]]]:
    try:
        names = os.listdir(folder)
    except OSError:  # there is no such folder, or it cannot be read: writing will say so
        return []
    return [(folder / name, named) for name in names if (named := _TEMPORARY.fullmatch(name))]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        remove_folder(path, path.parent)
    else:
        remove_file(path, path.parent)
