"""The backend's private environment: made by venv and pip, and tried.

What takes long is a process that a generator follows: it yields how far it is while it waits, so that a timer, or a
command, can drive it, and closing it ends the process.

env/           the virtual environment; env/ready.json, written last of all, says that it is finished
pip/           pip's cache: a set-up that was cancelled does not download again; removed when it has succeeded
temporary/     of pip and of the self-test
set_up.log     what venv and pip said
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

from ..files.regular_files import remove_file, remove_folder
from ..files.whole_files import write_atomically
from .client import BackendClient
from .environment import MARK, SetUpFolder
from .packages import Lock, clean_environment, followed, what_went_wrong
from .requests import Backend, ChildRequest, Step, Steps

OFFLINE = (
    "Blender may not use the network; allow it in Preferences > System > Network > Allow Online Access, "
    "or name an existing Python in the extension's preferences"
)
_TRIAL = {"seed": 0, "steps": 3, "size": 16}
_DOWNLOADED, _INSTALLED = 0.6, 0.9
"""Fractions of the progress bar at which these are done."""
_VENV = ("-I", "-m", "venv", "--clear")
_INSTALL = (
    "install", "--require-hashes", "--no-deps", "--only-binary", ":all:", "--no-compile", "--no-warn-script-location",
    "--disable-pip-version-check", "--no-input", "--no-color", "--progress-bar", "off",
)  # fmt: skip
"""Named wheels of known hashes alone, nothing built. The self-test compiles what the child imports."""


def set_up(folder: SetUpFolder, lock: Lock, compute: str, module_path: Path, cache: Path | None) -> Steps:
    """Rebuild the environment from the package index; it is ready once it has generated a human. `compute` (cpu, cuda
    or apple) is for its mark. Raises RuntimeError, and OSError."""
    python, host = folder.python, sys.executable
    _check_own(folder)
    folder.root.mkdir(parents=True, exist_ok=True)
    remove_file(folder.environment / MARK, folder.environment)
    remove_folder(folder.temporary, folder.temporary.parent)
    folder.temporary.mkdir(exist_ok=True)
    remove_file(folder.log, folder.log.parent)
    yield Step("Making the environment", 0.0)
    environment = clean_environment(folder.temporary, folder.downloads)
    making = [host, *_VENV, str(folder.environment)]
    for _ in followed(making, folder.log, environment, _no_venv):
        yield Step("Making the environment", 0.0)
    requirements = folder.temporary / "requirements.txt"
    write_atomically(requirements, lock.requirements)
    command = [*_pip(python), *_INSTALL, "-r", str(requirements)]
    for said in followed(command, folder.log, environment, what_went_wrong):
        yield _installing(folder, lock, said)
    about = yield from _trial(python, module_path, cache, folder.temporary)
    marked = {
        **about,
        "compute": compute,
        "lock": lock.digest,
        "lock_name": lock.path.name,
        "packages": len(lock.packages),
        "bytes": lock.installed_bytes,
        "base": host,
    }
    write_atomically(folder.environment / MARK, json.dumps(marked, indent=1))
    for leftover in (folder.downloads, folder.temporary):
        remove_folder(leftover, leftover.parent)
    device = about["device"] or "the CPU"
    return f"The backend is ready: torch {about['torch']} on {device}, tested in {about['seconds']:.0f} s"


def _check_own(folder: SetUpFolder) -> None:
    """Raises RuntimeError for links: what they lead to is not ours to empty."""
    for path in (folder.environment, folder.downloads, folder.temporary):
        if path.is_symlink():
            raise RuntimeError(f"{path} is a link to another folder: remove the link, then set the backend up again")


def _pip(python: Path) -> list[str]:
    return [str(python), "-I", "-m", "pip"]


def _trial(
    python: Path, module_path: Path, cache: Path | None, temporary: Path
) -> Generator[Step, None, dict[str, Any]]:
    """The real child makes a human; returns what it is and what it computes on.

    The human's previews are drawn, which compiles the marcher into `cache`: the first press does not wait for that.
    """

    backend, began = Backend(lambda: BackendClient(python, module_path, cache_dir=cache)), time.monotonic()
    person = temporary / "person"
    try:
        request = ChildRequest(backend, "generate", {**_TRIAL, "out_dir": str(person)})
        while not request.finished:
            yield Step(f"Testing the backend, which compiles its renderer, once: {request.message}", _INSTALLED)
            request.tick()
        if request.error is not None:
            last = f" ({request.error.log[-1]})" if request.error.kind == "died" and request.error.log else ""
            raise RuntimeError(f"the self-test failed: {request.error.message}{last}")
        if not request.result.person.is_file():
            raise RuntimeError("the self-test failed: the backend made no human and did not say why")
        return {
            "device": request.info.get("device_name") or "",
            "seconds": round(time.monotonic() - began, 1),
            **{name: request.info.get(name, "?") for name in ("torch", "python", "version")},
        }
    finally:
        backend.release()
        remove_folder(person, person.parent)


def _installing(folder: SetUpFolder, lock: Lock, said: str) -> Step:
    """How far pip is, by its files."""
    if "Installing collected packages" in said:
        return Step(f"Installing {len(lock.packages)} packages", _DOWNLOADED)
    total = max(lock.download_bytes, 1)
    now = min(_wheel_bytes(folder.temporary), total)
    return Step(f"Downloading, {now / 1e6:.0f} of {total / 1e6:.0f} MB", _DOWNLOADED * now / total)


def _wheel_bytes(folder: Path) -> int:
    """Bytes of the wheels below a folder, while pip adds and removes some."""
    total = 0
    for parent, _, names in os.walk(folder):
        with contextlib.suppress(OSError):
            total += sum(os.path.getsize(os.path.join(parent, name)) for name in names if name.endswith(".whl"))
    return total


def _no_venv(_said: str, _exit_code: int) -> str:
    return (
        f"the Python of this Blender ({sys.executable}) cannot make an environment: it lacks venv or ensurepip; "
        "install them (on Debian and Ubuntu: sudo apt install python3-venv), then try again"
    )
