"""Files and folders that appear whole or not at all, written under temporary names. Needs no numpy.

A temporary name, `.STEM.SPACE-PID-RANDOM.partial.SUFFIX`, is random and tells its writer: PID counts only where SPACE,
a digest of the machine's start and of its namespace of process ids, is the reader's own. What a killed process left is
removed by the next writer to the same place: at once where that process is known to have ended, and elsewhere (another
container, another machine on a network disk) when nothing of it has changed for a day.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

from .regular_files import check_inside, open_to_append, real_path, remove_file, remove_folder

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

ABANDONED_AFTER_S = 86_400.0
"""Age of a temporary file, seconds, from which its writer counts as ended where that cannot be asked."""
_WRITER = re.compile(r"(?P<space>[0-9a-f]{8})-(?P<pid>[0-9]{1,10})-[0-9a-f]{8}")
_TEMPORARY = re.compile(rf"\.(?P<stem>.*)\.{_WRITER.pattern}\.partial(?P<suffix>\.[^.]*)?")
_REPLACED = "replaced"


def writer() -> str:
    """This process, and a random part: for names of temporary files."""
    return f"{_space()}-{os.getpid()}-{secrets.token_hex(4)}"


def temporary_name(path: Path) -> Path:
    """An unused name beside `path`, to write to."""
    return path.with_name(f".{path.stem}.{writer()}.partial{path.suffix}")


@contextlib.contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder with a temporary name beside `path`; it is removed after the block. Raises OSError."""
    folder = temporary_name(path)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        remove_folder(folder, folder.parent)


def is_abandoned(path: Path) -> bool:
    """Whether a temporary file or folder belongs to no running process, as far as can be told."""
    named = _TEMPORARY.fullmatch(path.name)
    running = _is_running(named["space"], int(named["pid"])) if named else None
    if running is not None:
        return not running
    try:
        inside = list(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
        newest = max(entry.lstat().st_mtime for entry in (path, *inside))
    except OSError:  # gone meanwhile, or not ours
        return False
    return time.time() - newest > ABANDONED_AFTER_S


def has_ended(name: str) -> bool:
    """Whether a name that contains `writer()` is of a process that is known to have ended."""
    named = _WRITER.search(name)
    return named is not None and _is_running(named["space"], int(named["pid"])) is False


def remove_abandoned(folder: Path, of: Path | None = None) -> None:
    """Remove what killed processes left in a folder, only what was to become `of` if given. Raises no OSError."""
    for path in _temporary_files(folder):
        named = _TEMPORARY.fullmatch(path.name)
        if named and (of is None or (named["stem"], named["suffix"] or "") == (of.stem, of.suffix)):
            with contextlib.suppress(OSError):
                if is_abandoned(path):
                    _remove(path)


def remove_of_process(folder: Path, pid: int) -> None:
    """Remove what a process of this machine, which has been killed, left in a folder. Raises no OSError."""
    for path in _temporary_files(folder):
        named = _TEMPORARY.fullmatch(path.name)
        if named and (named["space"], int(named["pid"])) == (_space(), pid):
            with contextlib.suppress(OSError):
                _remove(path)


@contextlib.contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
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
def replacing(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """`written_whole`, after creating the folder of `path`; in `folder`, if given, out of which no link may lead.

    Raises FileError where one does.
    """
    if folder is not None:
        check_inside(path, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        yield unfinished


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8 with its line ends as they are on every system; creates its folder.

    Raises OSError, naming `path`.
    """
    with replacing(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def staged(folder: str | Path, last: str = "") -> Iterator[Path]:
    """Yield a temporary folder inside `folder`, to which its files move at the end, replacing files of the same names.

    The file named `last` moves last. After an error everything is removed, including a newly created `folder`. Raises
    OSError, naming the file in `folder`; at once if it cannot be written to.
    """
    with staged_together([folder], last) as (aside,):
        yield aside


@contextlib.contextmanager
def staged_together(folders: Sequence[str | Path], last: str = "") -> Iterator[list[Path]]:
    """`staged` for several folders, whose files move at the end in all of them or in none."""
    targets = [Path(folder) for folder in folders]
    made: list[Path] = []
    asides: list[Path] = []
    try:
        for target in targets:
            made += create_folders(target)
            remove_abandoned(target)
            asides.append(temporary_name(target / "files"))
            asides[-1].mkdir()
        yield asides
        publish(list(zip(asides, targets, strict=True)), last)
        made = []
    except OSError as e:
        for aside, target in zip(asides, targets, strict=False):
            if isinstance(e.filename, str | Path) and (path := Path(e.filename)).is_relative_to(aside):
                raise type(e)(e.errno, e.strerror, str(target / path.relative_to(aside))) from e
        raise
    finally:
        for aside in asides:
            remove_folder(aside, aside.parent)
        remove_empty(made)


def publish(moves: Sequence[tuple[Path, Path]], last: str = "") -> None:
    """Move the content of folders into others of the same disk: all of it, or after an error nothing.

    A file replaces a file of the same name, and a folder a folder. Of each pair the entry named `last` moves last.
    Of two processes one waits for the other, so that files of two results do not mix. Raises OSError;
    IsADirectoryError or NotADirectoryError, before anything moves, where a folder meets a file.
    """
    with contextlib.ExitStack() as held:
        for folder in sorted({real_path(folder) for _, folder in moves}):  # in one order: no process waits in a circle
            held.enter_context(_alone_in(folder))
        _publish(moves, last)


def _publish(moves: Sequence[tuple[Path, Path]], last: str) -> None:
    pieces = [
        (path, folder / path.name, made / _REPLACED / path.name)
        for made, folder in moves
        for path in sorted(made.iterdir(), key=lambda path: (path.name == last, path.name))
    ]
    for path, target, _ in pieces:
        if target.exists() and target.is_dir() != path.is_dir():
            what = "a folder" if target.is_dir() else "not a folder"
            number = errno.EISDIR if target.is_dir() else errno.ENOTDIR  # OSError becomes the class of its number
            raise OSError(number, f"this is {what} and will not be replaced", str(target))
    moved: list[tuple[Path, Path]] = []
    try:
        for path, target, old in pieces:
            if target.exists():
                _keep(target, old)
            moved.append((target, old))
            os.replace(path, target)
    except BaseException:
        for target, old in reversed(moved):
            with contextlib.suppress(OSError):
                if target.is_dir() or not old.exists():
                    _remove(target)
                if old.exists():
                    os.replace(old, target)
        raise
    finally:
        for made, _ in moves:
            remove_folder(made / _REPLACED, made)


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process publishes in a folder, which lasts as long as a few files take to be renamed.

    The system ends the wait when that process ends. Nothing stays in the folder. A disk without locks lets all in.
    """
    if sys.platform == "win32":
        lock = folder / ".publishing"
        with open_to_append(lock) as file:
            with contextlib.suppress(OSError):
                msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)  # waits for ten seconds
            yield
        with contextlib.suppress(OSError):  # the next process has it open
            remove_file(lock, folder)
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _keep(target: Path, old: Path) -> None:
    """Keep what is about to be replaced: a file stays in place meanwhile."""
    old.parent.mkdir(exist_ok=True)
    if target.is_dir():
        os.replace(target, old)
        return
    try:
        os.link(target, old)
    except OSError:  # a disk without links
        shutil.copy2(target, old)


def create_folders(folder: Path) -> list[Path]:
    """Create `folder` and its missing parents; return the created ones, innermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
    return missing


def remove_empty(created: Sequence[Path]) -> None:
    """Remove the created folders, unless they are in use."""
    for path in created:
        with contextlib.suppress(OSError):
            path.rmdir()


def _temporary_files(folder: Path) -> list[Path]:
    try:
        return [Path(entry.path) for entry in os.scandir(folder) if entry.name[0] == "." and ".partial" in entry.name]
    except OSError:  # there is no such folder, or it cannot be read: writing will say so
        return []


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        remove_folder(path, path.parent)
    else:
        remove_file(path, path.parent)


@lru_cache(maxsize=1)
def _space() -> str:
    """Digest of the machine's start and of its namespace of process ids; random where the system does not tell them."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        known = f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        known = platform.node() if sys.platform in ("darwin", "win32") else secrets.token_hex(8)
    return hashlib.sha256(known.encode()).hexdigest()[:8]


def _is_running(space: str, pid: int) -> bool | None:
    """None where it cannot be told: other machines and containers, and Windows."""
    if space != _space() or os.name == "nt" or pid < 1:
        return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    except OverflowError:
        return None
    return True
