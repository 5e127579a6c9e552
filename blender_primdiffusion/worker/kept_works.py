"""Works that outlive Blender: a JSON file for each process, beside a lock that tells whether it lives."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from .process_lock import ProcessLock, is_locked

_VERSION = 1


@dataclasses.dataclass(frozen=True)
class KeptWork:
    """What re-creates a work, and where it was asked for."""

    kind: str
    label: str
    """For people."""
    work: dict[str, Any]
    """The kind's own."""
    scene: str
    blend: str
    """Path of the file; empty for one never saved."""


class Shelf:
    """The works of this process in `folder`, and those that dead processes have left there."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._file = folder / f"{os.getpid()}-{time.time_ns()}.json"
        self._lock: ProcessLock | None = None

    def keep(self, works: Iterable[KeptWork]) -> None:
        """Make `works` all that is kept of this process. Raises OSError, and then what was kept before stays."""
        works = list(works)
        if not works:
            self._file.unlink(missing_ok=True)
            self.close()
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        if self._lock is None:
            self._lock = ProcessLock(self._file.with_suffix(".lock"))
        partial = self._file.with_suffix(".partial")
        content = {"version": _VERSION, "works": [dataclasses.asdict(work) for work in works]}
        partial.write_text(json.dumps(content), encoding="utf-8")
        partial.replace(self._file)

    def left(self) -> list[KeptWork]:
        """Works of dead processes, those of the oldest first."""
        return [work for path in self._of_the_dead() for work in _read(path)]

    def claim(self) -> list[KeptWork]:
        """As `left`, and nobody else will find them any more."""
        works = []
        for path in self._of_the_dead():
            own = path.with_suffix(f".claimed{os.getpid()}")
            try:
                path.replace(own)  # one of several Blenders succeeds
            except OSError:
                continue
            works += _read(own)
            for gone in (own, path.with_suffix(".lock"), path.with_suffix(".partial")):
                with contextlib.suppress(OSError):
                    gone.unlink()
        return works

    def close(self) -> None:
        """Let others have what is kept."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _of_the_dead(self) -> Iterator[Path]:
        for path in sorted(self._folder.glob("*.json"), key=_age):
            if path != self._file and not is_locked(path.with_suffix(".lock")):
                yield path


def _age(path: Path) -> int:
    """When the process began, which the name tells."""
    stamp = path.stem.rpartition("-")[2]
    return int(stamp) if stamp.isdecimal() else 0


def _read(path: Path) -> list[KeptWork]:
    """None of a file that is damaged or of another version."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return [KeptWork(**work) for work in content["works"]] if content["version"] == _VERSION else []
    except (OSError, ValueError, KeyError, TypeError):
        return []
