"""Which Python runs the backend, and the extension's own environment. Nothing is started to find out."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from ..files.json_files import read_json
from ..files.regular_files import is_local_path
from .client import PROGRAM

VARIABLE = "PRIMDIFFUSION_PYTHON"
MARK = "ready.json"
"""In the extension's own environment, when it is finished."""
LONGEST_INSIDE = 180
"""Characters of the longest path within site-packages (171 in torch 2.13), and some to spare."""
WINDOWS_LONGEST = 259
"""Characters of a whole path on Windows as it comes."""
NOT_INSTALLED = (
    "there is no backend on this computer: install PrimDiffusion's as the manual describes, then name its program "
    "or its Python in the extension's preferences"
)
"""Where the extension brings none."""
NOT_ABSOLUTE = (
    "the extension's preferences name {} by {!r}, which depends on the file that is open: choose it again, by its "
    "whole path on this computer (without Relative Path in the file browser)"
)
"""For paths of preferences: a stranger's folder must not supply what they name."""
NOT_SET_UP = (
    "the backend is not set up: press Set Up Backend, or name a Python with PrimDiffusion's packages in the preferences"
)
"""Where the extension brings one."""


class BackendNotFound(RuntimeError):
    """No Python to run the backend, or one that must not be."""

    kind = "environment"
    """The kind of the error that a request becomes."""


def python_of_environment(folder: Path) -> Path:
    """The interpreter of the virtual environment in `folder` on this system."""
    return folder / "Scripts" / "python.exe" if os.name == "nt" else folder / "bin" / "python"


@dataclasses.dataclass(frozen=True)
class SetUpFolder:
    """Names within the folder."""

    root: Path

    @property
    def environment(self) -> Path:
        """The virtual environment."""
        return self.root / "env"

    @property
    def python(self) -> Path:
        """The interpreter of the environment."""
        return python_of_environment(self.environment)

    @property
    def downloads(self) -> Path:
        """Packages that were downloaded for a set-up that has not finished."""
        return self.root / "downloads"

    @property
    def temporary(self) -> Path:
        """Folder of temporary files of the set-up and the self-test."""
        return self.root / "temporary"

    @property
    def log(self) -> Path:
        """The output of the set-up."""
        return self.root / "set_up.log"


def state_of(folder: SetUpFolder) -> tuple[Literal["absent", "broken", "ready"], dict[str, Any]]:
    """How far the environment is, and what its mark says of it. Takes a few file system calls.

    broken: never finished, or the Python that it was made with is gone (another Blender was put in its place).
    """
    if not folder.environment.is_dir():
        return "absent", {}
    try:
        about = read_json(folder.environment / MARK)
        made_with = Path(about["base"])
    except (OSError, ValueError, KeyError, TypeError):
        return "broken", {}
    return ("ready" if folder.python.exists() and made_with.exists() else "broken"), about


def short_root(own: Path, local: Path | None, name: str) -> Path:
    """Where the environment goes: the extension's own folder, or, where Windows could not hold its longest paths, a
    folder `name` in the user's local application data (`local`; None: it is not Windows)."""
    longest = len(f"{own}/env/Lib/site-packages/") + LONGEST_INSIDE
    return own if local is None or longest <= WINDOWS_LONGEST else local / "primdiffusion" / name


def candidates(
    preference: str | Path | None,
    own_environment: Path | None,
    installed: Path | None = None,
    *,
    own_python: bool = True,
) -> Iterator[tuple[str, Path]]:
    """Who may name the Python, strongest first: the preferences, the variable, the extension's own, the program
    `installed` by the user, the running one (with `own_python`).

    An explicit wish (preferences or variable) that fails is an error and not a reason to look further. An environment
    of the extension's own that is not finished is passed over. Raises BackendNotFound where the preferences name a path
    that is not absolute, or on another server.
    """
    if preference and str(preference).strip():
        if not is_local_path(str(preference)):
            raise BackendNotFound(NOT_ABSOLUTE.format("a Python", str(preference)[:200]))
        yield "the extension's preferences", Path(preference)
        return
    if os.environ.get(VARIABLE):
        yield f"the environment variable {VARIABLE}", Path(os.environ[VARIABLE])
        return
    if own_environment is not None and (own_environment / MARK).exists():
        python = python_of_environment(own_environment)
        if python.exists():
            yield "the extension's own environment", python
    if installed is not None:
        yield "the PATH", installed
    if own_python:
        yield "Blender's own Python", Path(sys.executable)


@functools.cache
def own_python_has_backend(bundled: bool) -> bool:
    """Whether Blender's own Python has the backend, or torch for one that the extension brings."""
    return importlib.util.find_spec("torch" if bundled else PROGRAM) is not None


def find_python(
    preference: str | Path | None = None,
    own_environment: Path | None = None,
    module_path: Path | None = None,
    installed: Path | None = None,
) -> tuple[str, Path]:
    """The first of `candidates`: who names it, and the path of the Python or program.

    `module_path` as in `child_environment`. Raises BackendNotFound where there is none.
    """
    own_python = own_python_has_backend(module_path is not None)
    found = next(candidates(preference, own_environment, installed, own_python=own_python), None)
    if found is None:
        raise BackendNotFound(NOT_INSTALLED if module_path is None else NOT_SET_UP)
    return found
