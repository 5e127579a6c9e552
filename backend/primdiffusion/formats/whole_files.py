"""Files written whole or not at all. Needs no numpy."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from .removing import remove_file


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` at the end, or is removed after an error.

    OSErrors name `path`, also those of a full disk, for which Python names no file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    remove_file(partial, partial.parent)  # a link of that name would be followed
    try:
        yield partial
        os.replace(partial, path)
    except OSError as e:
        if e.errno is None or e.filename not in (None, str(partial)):
            raise
        raise OSError(e.errno, e.strerror, str(path)) from e
    finally:
        remove_file(partial, partial.parent)
