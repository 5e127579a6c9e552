"""Which Python runs the backend: found and tried before a child is started with it."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from ..files.json_files import parse_json, read_json
from ..files.regular_files import is_local_path
from .child_process import Output
from .client import PROGRAM, child_environment, is_program

VARIABLE = "PRIMDIFFUSION_PYTHON"
MARK = "ready.json"
"""In the extension's own environment, when it is finished."""
LONGEST_INSIDE = 180
"""Characters of the longest path within site-packages (171 in torch 2.13), and some to spare."""
WINDOWS_LONGEST = 259
"""Characters of a whole path on Windows as it comes."""
TRIAL_S = 90.0
"""A first import of torch from a slow disk, with a virus scanner, takes most of a minute."""
TRIAL = (
    "import sys; sys.version_info >= (3, 11) or sys.exit('it is Python %d.%d, and 3.11 or newer is needed' "
    "% sys.version_info[:2]); import json, primdiffusion, torch; "
    "print(json.dumps({'version': primdiffusion.__version__, 'torch': torch.__version__, "
    "'python': sys.version.split()[0]}))"
)


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
tried: dict[Path, bool] = {}
"""Interpreters that were tried since Blender was started, and whether they imported torch and the backend."""


class BackendNotFound(RuntimeError):
    """No Python that can run the backend; the message names each that was tried and why it will not do."""

    kind = "environment"
    """The kind of the error that a request becomes."""


class ImportTimedOut(BackendNotFound):
    """A Python took too long to import torch; on a busy machine another attempt may succeed."""

    kind = "timeout"


@dataclasses.dataclass(frozen=True)
class BackendPython:
    """An interpreter that has imported torch and the backend."""

    path: Path
    source: str
    """Who named it, in words for the user."""
    version: str
    """primdiffusion's version."""
    torch: str
    python: str


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
        yield "the extension's own environment", python_of_environment(own_environment)
    if installed is not None:
        yield "the PATH", installed
    if own_python:
        yield "Blender's own Python", Path(sys.executable)


def own_python_has_backend() -> bool:
    """Whether the backend is installed in Blender's own Python."""
    return importlib.util.find_spec(PROGRAM) is not None


def search(
    preference: str | Path | None = None,
    own_environment: Path | None = None,
    module_path: Path | None = None,
    *,
    installed: Path | None = None,
    cache_dir: Path | None = None,
    timeout_s: float = TRIAL_S,
) -> Generator[None, None, BackendPython]:
    """Try each candidate in a process of its own, which takes seconds; yields while it runs, and returns the first that
    imports primdiffusion and torch.

    `installed` as in `candidates`; `module_path` and `cache_dir` as in `child_environment`. Raises BackendNotFound with
    one reason for each candidate, ImportTimedOut where one of them took longer than `timeout_s`.
    """
    environment = child_environment(module_path, cache_dir, {})
    errors: list[BackendNotFound] = []
    own_python = module_path is not None or own_python_has_backend()
    for source, path in candidates(preference, own_environment, installed, own_python=own_python):
        try:
            found = yield from _try(path, source, environment, timeout_s)
        except BackendNotFound as e:
            errors.append(e)
            tried[path] = False
        else:
            tried[path] = True
            return found
    reasons = "; ".join(map(str, errors))
    if not errors:
        raise BackendNotFound(NOT_INSTALLED)
    advice = "name a Python with PrimDiffusion's packages in the extension's preferences"
    if module_path is not None:
        advice = f"press Set Up Backend, or {advice}"
    if any(isinstance(error, ImportTimedOut) for error in errors):
        raise ImportTimedOut(f"No Python for the backend: the machine may be busy, try again; or {advice}. {reasons}.")
    raise BackendNotFound(f"No Python for the backend: {advice}. {reasons}.")  # Blender's report cuts the end


def _try(
    path: Path, source: str, environment: Mapping[str, str], timeout_s: float
) -> Generator[None, None, BackendPython]:
    named = f"{path} ({source})"
    answer, errors = Output(), Output()
    try:
        process = subprocess.Popen(
            [str(path), "serve", "--about"] if is_program(path) else [str(path), "-c", TRIAL],
            stdin=subprocess.DEVNULL,
            stdout=answer.target,
            stderr=errors.target,
            env=dict(environment),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        end = time.monotonic() + timeout_s
        try:
            while (exit_code := process.poll()) is None:
                if time.monotonic() > end:
                    raise ImportTimedOut(f"{named} did not import torch within {timeout_s:.0f} s")
                yield
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        answered, complaints = answer.log(), errors.log()
    except FileNotFoundError as e:
        raise BackendNotFound(f"{named} does not exist") from e
    except OSError as e:
        raise BackendNotFound(f"{named} cannot be run: {e.strerror}") from e
    finally:
        answer.close()
        errors.close()
    if exit_code != 0:
        raise BackendNotFound(f"{named} cannot run it: {complaints[-1] if complaints else f'exit code {exit_code}'}")
    try:
        about = parse_json(answered[-1])
        return BackendPython(path, source, about["version"], about["torch"], about["python"])
    except (ValueError, IndexError, KeyError) as e:
        raise BackendNotFound(f"{named} is no Python interpreter: it answered {answered[:1]}") from e
