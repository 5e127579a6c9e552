"""The folder of the private environment: what lies in it, whether it is finished.

env/           the virtual environment; env/unfinished from its first moment, env/ready.json written last of all
wheels/        what has been downloaded; kept until the environment is ready, so that setting up can be resumed
temporary/     of pip and of the self-test
set_up.log     everything that was said
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

State = Literal["absent", "half", "moved", "ready"]
LONGEST_INSIDE = 180
"""Characters of the longest path within site-packages (171 in torch 2.13), and some to spare."""
WINDOWS_LONGEST = 259
"""Characters of a whole path on Windows as it comes."""
_SITE_PACKAGES = "/env/Lib/site-packages/"


@dataclasses.dataclass(frozen=True)
class SetUpFolder:
    """Names within the folder."""

    root: Path

    @property
    def environment(self) -> Path:
        """The virtual environment."""
        return self.root / "env"

    @property
    def wheels(self) -> Path:
        """What has been downloaded."""
        return self.root / "wheels"

    @property
    def temporary(self) -> Path:
        """Of pip and of the self-test."""
        return self.root / "temporary"

    @property
    def log(self) -> Path:
        """Everything that was said."""
        return self.root / "set_up.log"

    @property
    def guard(self) -> Path:
        """Locked while a set-up is at work here."""
        return self.root / "set_up.lock"

    @property
    def python(self) -> Path:
        """The interpreter of the environment."""
        if os.name == "nt":
            return self.environment / "Scripts" / "python.exe"
        return self.environment / "bin" / "python"


def short_root(own: Path, local: Path | None, name: str) -> Path:
    """Where the environment goes: the extension's own folder, or, where Windows could not hold its longest paths, a
    folder `name` in the user's local application data (`local`; None: it is not Windows)."""
    longest = len(str(own)) + len(_SITE_PACKAGES) + LONGEST_INSIDE
    return own if local is None or longest <= WINDOWS_LONGEST else local / "primdiffusion" / name


def state_of(folder: SetUpFolder) -> tuple[State, dict[str, Any]]:
    """How far the environment is, and what its marker tells of it. Takes a few file system calls.

    moved: it was finished, but the Python that it was made with is gone (another Blender was put in its place).
    """
    if not folder.environment.is_dir():
        return ("half" if folder.wheels.is_dir() else "absent"), {}
    try:
        about = json.loads((folder.environment / "ready.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return "half", {}
    if not isinstance(about, dict):
        return "half", {}
    if not folder.python.exists() or not Path(about.get("base", sys.executable)).exists():
        return "moved", about
    return "ready", about


def is_half_installed(environment: Path) -> bool:
    """An environment of ours that is being set up, or whose setting up was interrupted."""
    return (environment / "unfinished").exists() and not (environment / "ready.json").exists()


def mark_unfinished(folder: SetUpFolder) -> None:
    """The environment is begun: an empty folder with a mark. What was there is gone. Raises OSError."""
    remove_tree(folder.environment)
    folder.environment.mkdir(parents=True)
    (folder.environment / "unfinished").touch()


def mark_ready(folder: SetUpFolder, about: Mapping[str, Any]) -> None:
    """The environment is finished; nothing is needed any more that it was made of. Raises OSError."""
    written = folder.environment / "ready.json.part"
    written.write_text(json.dumps(dict(about), indent=1), encoding="utf-8")
    os.replace(written, folder.environment / "ready.json")
    (folder.environment / "unfinished").unlink(missing_ok=True)
    for leftover in (folder.wheels, folder.temporary):
        shutil.rmtree(leftover, ignore_errors=True)


def unmark(folder: SetUpFolder) -> None:
    """The environment is not to be relied on any more."""
    if folder.environment.is_dir():
        (folder.environment / "unfinished").touch()
        (folder.environment / "ready.json").unlink(missing_ok=True)


def remove_tree(path: Path) -> None:
    """A folder and all in it, if it is there. Raises OSError in a sentence when a file is in use."""
    try:
        shutil.rmtree(path)
    except FileNotFoundError:
        return
    except OSError as error:
        raise OSError(f"{path} cannot be removed ({error.strerror}): close other Blenders, then try again") from error


def bytes_of(path: Path) -> int:
    """Bytes of all files below a folder; 0 when there is none."""
    total = 0
    for folder, _, names in os.walk(path):
        for name in names:
            file = os.path.join(folder, name)
            total += 0 if os.path.islink(file) else os.path.getsize(file)
    return total
