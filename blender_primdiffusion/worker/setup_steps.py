"""Setting up the private environment, step by step: a generator, so that its caller owns showing and stopping it."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from .environment import python_of_environment
from .setup_folder import SetUpFolder, bytes_of, mark_ready, mark_unfinished, remove_tree, state_of, unmark
from .setup_locks import Lock, Package, grouped, read_lock
from .setup_pip import OLDEST_PIP, Pip, SetUpFailed, clean_environment, said_by, sha256_of
from .setup_records import damaged
from .setup_trial import Tried, try_backend

GROUP_BYTES = 20_000_000
"""A run of pip fetches this much, or one large wheel."""
SPARE = 1.05
"""Of disk space, for byte code and what pip needs meanwhile."""
OFFLINE = (
    "Blender may not use the network; allow it in Preferences > System > Network > Allow Online Access, "
    "or use Install from Folder"
)
_DOWNLOADED, _INSTALLED = 0.6, 0.9
"""Of the bar, when these are done."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is to be set up, and where. Plain values: it travels to another process as JSON."""

    host: str
    """The Python that makes the environment: Blender's."""
    root: str
    module_path: str
    """The folder that holds the package `primdiffusion`."""
    cache: str
    """Of the child: byte code and compiled kernels; for `remove` empty where it is to stay."""
    lock: str = ""
    """For `set_up` and `repair`: the file that names the packages."""
    offline: str = ""
    """A folder of wheels; empty: from the package index."""
    compute: str = ""
    """cpu, cuda or apple, for the record."""
    online: bool = True
    """Whether the user lets Blender use the network."""
    python: str = ""
    """For `self_test` alone: the interpreter to try; empty: the environment's."""

    @property
    def folder(self) -> SetUpFolder:
        """Where it goes."""
        return SetUpFolder(Path(self.root))


@dataclasses.dataclass(frozen=True)
class Step:
    """How far it is."""

    message: str
    fraction: float
    """Of everything, 0 to 1."""
    result: dict[str, Any] | None = None
    """In the last step: what has become of it."""


def set_up(plan: Plan, log: IO[str]) -> Iterator[Step]:
    """Downloads what is missing, installs it into a new environment, tries it. Ends with a result.

    Raises SetUpFailed in a sentence, and OSError. What has been downloaded stays until it has succeeded.
    """
    folder, lock = plan.folder, _lock(plan)
    yield Step("Checking", 0.0)
    _check_online(plan, lock)
    _check_disk(folder, lock, Path(plan.offline) if plan.offline else folder.wheels)
    remove_tree(folder.temporary)
    folder.temporary.mkdir(parents=True)
    mark_unfinished(folder)
    yield Step("Making the environment", 0.0)
    pip = _new_environment(plan, log)
    wheels = Path(plan.offline) if plan.offline else folder.wheels
    if plan.offline:
        yield from _check_folder(lock, wheels)
    else:
        yield from _download(plan, lock, pip)
    yield from _install(lock, pip, wheels)
    yield from _finish(plan, lock)


def repair(plan: Plan, log: IO[str]) -> Iterator[Step]:
    """Compares every installed file with its record; sets up anew when one differs. Raises as `set_up` does."""
    folder = plan.folder
    lock, (state, about) = _lock(plan), state_of(folder)
    yield Step("Comparing the installed files", 0.0)
    if state == "ready" and about.get("lock") == lock.digest:
        wrong = damaged(folder.environment)
        if wrong is None:
            for step in self_test(plan):
                if step.result is not None:
                    message = f"Nothing had to be repaired. {step.message}"
                    step = Step(message, 1.0, {**about, **step.result})
                yield step
            return
        log.write(f"{wrong}\n")
    _check_online(plan, lock)
    unmark(folder)
    yield from set_up(plan, log)


def self_test(plan: Plan) -> Iterator[Step]:
    """Only tries: the environment, or another Python that the plan names. Raises SetUpFailed."""
    folder = plan.folder
    folder.temporary.mkdir(parents=True, exist_ok=True)
    python = Path(plan.python) if plan.python else folder.python
    for said in try_backend(python, Path(plan.module_path), Path(plan.cache), folder.temporary):
        if isinstance(said, Tried):
            yield Step(_sentence_of(said), 1.0, dataclasses.asdict(said))
        else:
            yield Step(said, _INSTALLED)


def remove(plan: Plan) -> Iterator[Step]:
    """Environment, downloads and caches are gone; nothing else in the folder is touched. Raises OSError."""
    folder = plan.folder
    yield Step("Removing the environment", 0.0)
    going = [folder.environment, folder.wheels, folder.temporary, *([Path(plan.cache)] if plan.cache else ())]
    freed = sum(map(bytes_of, going))
    unmark(folder)
    for done, path in enumerate(going, 1):
        remove_tree(path)
        yield Step("Removing the environment", done / len(going))
    yield Step(f"The backend was removed; {freed / 1e6:.0f} MB are free again", 1.0, {"freed": freed})


def _lock(plan: Plan) -> Lock:
    try:
        return read_lock(Path(plan.lock))
    except (OSError, ValueError) as error:
        raise SetUpFailed(f"the list of packages cannot be read: {error}") from error


def _check_online(plan: Plan, lock: Lock) -> None:
    """Before what is there is given up: what is missing can be fetched, as far as Blender's preferences go."""
    missing = () if plan.offline or plan.online else _missing(lock, plan.folder.wheels)
    if missing:
        raise SetUpFailed(f"{len(missing)} packages have to be downloaded: {OFFLINE}")


def _check_disk(folder: SetUpFolder, lock: Lock, wheels: Path) -> None:
    """What is there already of downloads and of an old environment counts as free: it is used, or goes first."""
    folder.root.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder.root).free + bytes_of(folder.environment)
    there = min(bytes_of(wheels), lock.download_bytes)
    needed = int((lock.installed_bytes + lock.download_bytes - there) * SPARE)
    if free < needed:
        raise SetUpFailed(
            f"{free / 1e9:.1f} GB are free on the disk of {folder.root}, and {needed / 1e9:.1f} GB are needed: "
            "free some space, then try again"
        )


def _new_environment(plan: Plan, log: IO[str]) -> Pip:
    """The virtual environment, empty, and a pip for it: the host's, or one of its own where the host has none."""
    folder = plan.folder
    _check_host(plan)
    making = [plan.host, "-I", "-m", "venv"]
    python = str(python_of_environment(folder.environment))
    pips = [[plan.host, "-m", "pip", "--python", python], [python, "-I", "-m", "pip"]]
    for options, command in zip((["--without-pip"], []), pips, strict=True):
        with contextlib.suppress(SetUpFailed):  # the next way is tried; the log keeps what this one said
            _run([*making, *options, str(folder.environment)], folder, log)
            pip = Pip(command, folder, log)
            if pip.version() >= OLDEST_PIP:
                return pip
    raise SetUpFailed(
        f"the Python of this Blender ({plan.host}) cannot make an environment: it lacks venv, or both ensurepip and "
        "pip; install them (on Debian and Ubuntu: sudo apt install python3-venv), then try again"
    )


def _check_host(plan: Plan) -> None:
    """The host runs, and is one of 3.11 or newer. Raises SetUpFailed."""
    asked = [plan.host, "-I", "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    try:
        done = subprocess.run(
            asked,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            env=clean_environment(plan.folder.temporary),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            check=False,
        )
    except OSError as error:
        raise SetUpFailed(f"{plan.host} cannot be run: {error.strerror}") from error
    found = re.fullmatch(r"(\d+)\.(\d+)", done.stdout.strip())
    if done.returncode != 0 or found is None:
        raise SetUpFailed(f"{plan.host} is no Python that can be run")
    if (int(found[1]), int(found[2])) < (3, 11):
        raise SetUpFailed(f"{plan.host} is Python {found[0]}, and 3.11 or newer is needed")


def _run(command: list[str], folder: SetUpFolder, log: IO[str]) -> None:
    for _ in said_by(command, folder, log):
        pass


def _check_folder(lock: Lock, wheels: Path) -> Iterator[Step]:
    """Every package has its wheel in the folder. Raises SetUpFailed with the missing ones."""
    yield Step("Checking the wheels in the folder", 0.0)
    missing = _missing(lock, wheels)
    if missing:
        named = ", ".join(f"{package.name} {package.version}" for package in missing[:4])
        more = f" and {len(missing) - 4} more" if len(missing) > 4 else ""
        raise SetUpFailed(
            f"the folder {wheels} lacks the right wheels of {named}{more}: "
            f"fetch them with 'pip download -r {lock.path.name}' (see the manual)"
        )


def _missing(lock: Lock, wheels: Path) -> tuple[Package, ...]:
    there = {sha256_of(path) for path in wheels.glob("*.whl")} if wheels.is_dir() else set()
    return tuple(package for package in lock.packages if package.sha256 not in there)


def _download(plan: Plan, lock: Lock, pip: Pip) -> Iterator[Step]:
    """Fetches what is not there yet; a group of packages is moved into place when all of it is there."""
    folder = plan.folder
    folder.wheels.mkdir(exist_ok=True)
    missing, total = _missing(lock, folder.wheels), max(lock.download_bytes, 1)
    have = total - sum(package.bytes for package in missing)
    number = len(lock.packages) - len(missing)
    arriving = folder.wheels / "arriving"
    for group in grouped(missing, GROUP_BYTES):
        remove_tree(arriving)
        arriving.mkdir()
        size = sum(package.bytes for package in group)
        title = f"Downloading {max(group, key=lambda package: package.bytes).name}"
        for arrived in pip.download(group, lock, arriving):
            now = have + min(arrived, size)
            counted = f"{title}: package {number + len(group)} of {len(lock.packages)}"
            yield Step(f"{counted}, {now / 1e6:.0f} of {total / 1e6:.0f} MB", _DOWNLOADED * now / total)
        for wheel in arriving.iterdir():
            os.replace(wheel, folder.wheels / wheel.name)
        have, number = have + size, number + len(group)
    remove_tree(arriving)


def _install(lock: Lock, pip: Pip, wheels: Path) -> Iterator[Step]:
    total, done, number = max(lock.installed_bytes, 1), 0, 0
    for group in grouped(lock.packages, GROUP_BYTES):
        number += len(group)
        title = f"Installing {max(group, key=lambda package: package.bytes).name}"
        share = _DOWNLOADED + (_INSTALLED - _DOWNLOADED) * done / total
        yield Step(f"{title}: package {number} of {len(lock.packages)}", share)
        pip.install(group, wheels)
        done += sum(package.installed for package in group)


def _finish(plan: Plan, lock: Lock) -> Iterator[Step]:
    """The self-test, and the mark of a finished environment after it."""
    for step in self_test(plan):
        if step.result is None:
            yield step
            continue
        folder = plan.folder
        about = {
            **step.result,
            "compute": plan.compute,
            "lock": lock.digest,
            "lock_name": lock.path.name,
            "packages": len(lock.packages),
            "bytes": bytes_of(folder.environment),
            "base": plan.host,
            "made": datetime.date.today().isoformat(),
        }
        mark_ready(folder, about)
        yield dataclasses.replace(step, result=about)


def _sentence_of(tried: Tried) -> str:
    return f"The backend is ready: torch {tried.torch} on {tried.device or 'the CPU'}, tried in {tried.seconds:.0f} s"
