"""Open regular files alone, within a size: no folders, pipes, devices or endless files; and remove files without
leaving the folder that they belong to. Needs no numpy."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

_REMOTE = re.compile(r"[\\/]{2}|[a-z][a-z0-9+.-]+:[\\/]", re.IGNORECASE)
"""Starts of UNC paths, Windows' devices and URLs."""
_DEVICE = re.compile(r"^(con|prn|aux|nul|com\d|lpt\d)(?=\.|$)", re.IGNORECASE)
"""Stems of names that are devices in every folder of Windows."""
_LONGEST_PATH = 4096


class FileError(ValueError):
    """A file or folder that cannot be used: which one, what is wrong with it, and what to do."""

    def __init__(self, path: Path | str, reason: str = "", remedy: str = ""):
        """`reason` is a predicate ("is damaged"), `remedy` an imperative ("download it again").

        A single argument is the whole sentence: torch's data loader raises a worker's error anew from its text.
        """
        self.path, self.reason, self.remedy = path, reason, remedy
        super().__init__(path, reason, remedy)  # by which it is pickled

    def __str__(self) -> str:
        return f"{self.path} {self.reason}: {self.remedy}" if self.reason else str(self.path)


@contextlib.contextmanager
def as_file_error(path: Path | str, reason: str, remedy: str, *also: type[Exception]) -> Iterator[None]:
    """Raise FileError, with the words of the error in brackets, for what damaged content raises, and for `also`.

    A FileError passes through, because it already says what is wrong.
    """
    try:
        yield
    except FileError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, *also) as error:
        text = f"it lacks {error}" if isinstance(error, KeyError) else str(error).removeprefix(f"{path}: ")
        words = " ".join(text.split())
        raise FileError(path, f"{reason} ({words:.120})", remedy) from error


def real_path(path: str | Path) -> Path:
    """Return the absolute path with all links followed; Path.resolve raises RuntimeError for links in a circle."""
    return Path(os.path.realpath(path))


def check_regular(path: str | Path) -> os.stat_result:
    """Return the status of a regular file, without opening it.

    Raises FileNotFoundError, FileError for a folder, and PermissionError for pipes, sockets and devices.
    """
    try:
        status = os.stat(path)
    except ValueError as e:  # a null character
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path)[:200].replace("\0", "?")) from e
    if stat.S_ISDIR(status.st_mode):
        raise FileError(path, "is a folder", "give the file in it")
    if not stat.S_ISREG(status.st_mode):
        raise PermissionError(errno.EPERM, "this is not a regular file", str(path))
    return status


def open_regular(path: str | Path, limit: int) -> io.BufferedReader | io.BytesIO:
    """Open a regular file of at most `limit` bytes for reading, otherwise FileError. Raises as `check_regular`.

    A file that states no size is read as empty: those of /proc may be endless.
    """
    size = check_regular(path).st_size  # before it is opened: to open a device may already do something
    check_size(path, size, limit)
    return open(path, "rb") if size else io.BytesIO()


def read_regular(path: str | Path, limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes. Raises as `open_regular`."""
    with open_regular(path, limit) as file:
        size = file.seek(0, io.SEEK_END)  # some files grow
        check_size(path, size, limit)
        file.seek(0)
        return file.read(size)  # not up to the limit, for which Python would take memory


def check_size(path: str | Path, size: int, limit: int) -> None:
    """Raise FileError where `size` is over `limit`, bytes."""
    if size > limit:
        raise FileError(path, f"is larger than {limit / 2**20:.0f} MB, the most for its kind", "use a smaller file")


def is_local_path(path: str) -> bool:
    """Return whether a path is absolute and of this computer: no server, device or URL. Folders may have any name."""
    return 0 < len(path) <= _LONGEST_PATH and "\0" not in path and not _REMOTE.match(path) and os.path.isabs(path)


def printable(text: str) -> str:
    """Return `text` of a file, or with the name of one, for a terminal or a panel.

    Spaces of all kinds, line ends and tabs become spaces; characters that control the screen or the order of letters,
    and bytes that are not UTF-8, become "?".
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else " " if letter.isspace() else "?" for letter in text)


def portable_name(name: str) -> str:
    """Return `name` as a file or folder may be called on every system: CON, nul.png and `x. ` are not, on Windows."""
    return _DEVICE.sub(r"\1_", name.rstrip(". "))


def exists_in_its_folder(path: Path) -> bool:
    """Return whether `path` is a regular file, and if it is a link, one to a file in its own folder. Does not raise."""
    if not os.path.isfile(path):
        return False
    return not os.path.islink(path) or real_path(path).is_relative_to(real_path(path.parent))


def check_inside(path: Path, folder: Path) -> None:
    """Raise FileError unless `path` lies in `folder` after all links on the way to it are followed.

    `folder` itself may be reached through links. A link in the last component is not followed.
    """
    name, root = path.name, real_path(folder)
    place = real_path(path.parent) / name
    if name in ("", "..") or place == root or not place.is_relative_to(root):
        reason = f"lies outside of {folder}, behind a link, and stays as it is"
        raise FileError(path, reason, "remove the link, or the file itself")


def remove_file(path: Path, folder: Path) -> None:
    """Remove a file in `folder`, if it is there; of a link the link itself. Raises FileError, OSError."""
    check_inside(path, folder)
    path.unlink(missing_ok=True)


def remove_folder(path: Path, folder: Path) -> None:
    """Remove a folder in `folder` with its content, as far as the system permits; links are never followed.

    Raises FileError.
    """
    check_inside(path, folder)
    shutil.rmtree(path, ignore_errors=True)


def check_unlinked(path: Path) -> None:
    """Raise FileError for a link, and for a folder that contains a link to a folder outside: writing would leave it.

    Folders are listed to their ends. Call it for a folder before files are written below it, of which a library may
    write some; a folder that the user has named may be a link: pass its `real_path`.
    """
    if os.path.islink(path):
        raise FileError(path, "is a link", "remove the link, or choose a new folder")
    root = real_path(path)
    for inner, names, _ in os.walk(path):
        for link in filter(os.path.islink, (os.path.join(inner, name) for name in names)):
            if not real_path(link).is_relative_to(root):
                raise FileError(link, "is a link to another folder", "remove the link, or choose a new folder")


def open_to_append(path: Path) -> io.BufferedWriter:
    """Open a regular file, made if it is missing, to add to its end. Raises FileError for a link, OSError."""
    check_unlinked(path)
    if os.path.exists(path):
        check_regular(path)  # before it is opened: a pipe would wait for its reader
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    return open(os.open(path, flags, 0o666), "wb")
