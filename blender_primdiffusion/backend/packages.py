"""Which wheels make the backend's environment on this machine, and the commands (venv, pip) that install them.

A lock is a file of pip's requirements format. Nothing is started to find out what the machine is.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from pathlib import Path

from ..files.regular_files import read_regular
from .child_process import NETWORK, passed_on

CUDA_DRIVER = 580
"""The oldest NVIDIA driver that torch's CUDA 13 builds run on."""
MACOS = 14
"""The oldest macOS that torch has wheels for."""
NAMES = {"cpu": "CPU", "cuda": "NVIDIA (CUDA)", "apple": "Apple Silicon"}
_SYSTEMS = {"Linux": "linux", "Windows": "windows", "Darwin": "macos"}
_CHIPS = {"x86_64": "x86_64", "AMD64": "x86_64", "arm64": "arm64", "aarch64": "arm64"}
_REQUIREMENT = re.compile(
    r"(?P<whole>(?P<name>[A-Za-z0-9][A-Za-z0-9._-]*)==(?P<version>[A-Za-z0-9][A-Za-z0-9.+!_-]*)"
    r"(?: +--hash=sha256:[0-9a-f]{64})+)(?: +# (?P<bytes>\d{1,15}) bytes, (?P<installed>\d{1,15}|\?) installed)?"
)
_INDEX = re.compile(r"--extra-index-url https://[A-Za-z0-9.-]+(?::\d+)?(?:/[A-Za-z0-9._~%/+-]*)?")
_LARGEST_LOCK = 4 << 20
"""Bytes."""
_UNPACKED_TO_PACKED = 3.0
"""For a wheel of which it is not known what it unpacks to; torch's CPU build for Linux has 3.6."""


@dataclasses.dataclass(frozen=True)
class Package:
    """One wheel of a lock."""

    name: str
    version: str
    bytes: int
    """Size of the file; 0 where the lock does not say."""
    installed: int
    """Bytes that it unpacks to, or about that."""


@dataclasses.dataclass(frozen=True)
class Lock:
    """Every package of an environment, each with the hash of its one wheel."""

    path: Path
    digest: str
    """SHA-256 of the file: says whether an environment was made of this very lock."""
    packages: tuple[Package, ...]
    requirements: str
    """The lines that were read, for pip: of the file itself pip would also read what a coding line or a backslash hides
    from us."""

    @property
    def download_bytes(self) -> int:
        """Size of all wheels, bytes."""
        return sum(package.bytes for package in self.packages)

    @property
    def installed_bytes(self) -> int:
        """Approximate size of the environment."""
        return sum(package.installed for package in self.packages)


def read_lock(path: Path) -> Lock:
    """The lock in a file: requirements with their hashes, comments, and at most one --extra-index-url.

    Raises OSError, and ValueError for any other line.
    """
    data = read_regular(path, _LARGEST_LOCK)
    packages, lines = [], []
    for number, line in enumerate(map(str.strip, data.decode("utf-8", "replace").splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        if _INDEX.fullmatch(line) and not any(map(_INDEX.fullmatch, lines)):
            lines.append(line)
            continue
        found = _REQUIREMENT.fullmatch(line)
        if found is None:
            raise ValueError(
                f"line {number} of {path} is neither 'name==version --hash=sha256:...' nor the one line "
                f"'--extra-index-url https://...': {line[:60]!r:.80}"
            )
        lines.append(found["whole"])
        size = int(found["bytes"] or 0)
        unknown = found["installed"] in (None, "?")
        installed = int(size * _UNPACKED_TO_PACKED) if unknown else int(found["installed"])
        packages.append(Package(found["name"], found["version"], size, installed))
    if not packages:
        raise ValueError(f"{path} names no packages")
    return Lock(path, hashlib.sha256(data).hexdigest(), tuple(packages), "".join(f"{line}\n" for line in lines))


def locks_for(folder: Path, platform: str, python: tuple[int, int]) -> dict[str, Path]:
    """The locks in `folder` for a platform and a Python, by what they compute on: cpu, cuda, apple."""
    start = f"{platform}-py{python[0]}{python[1]}-"
    return {path.stem.removeprefix(start): path for path in sorted(folder.glob(f"{start}*.txt"))}


@dataclasses.dataclass(frozen=True)
class Machine:
    """The facts that the choice of packages depends on."""

    platform: str
    """linux_x86_64, linux_arm64, windows_x86_64, macos_arm64, or one without locks such as macos_x86_64."""
    python: tuple[int, int]
    macos: int | None
    nvidia: bool
    """There is an NVIDIA driver."""
    driver: int | None
    """The driver's major version, where a file of the system states it."""


def this_machine() -> Machine:
    """The machine we run on. Reads one small file at most."""
    chip = _CHIPS.get(platform.machine(), platform.machine().lower())
    version = platform.mac_ver()[0]
    nvidia, driver = _nvidia()
    return Machine(
        f"{_SYSTEMS.get(platform.system(), platform.system().lower())}_{chip}",
        sys.version_info[:2],
        int(version.split(".")[0]) if version else None,
        nvidia,
        driver,
    )


def _nvidia() -> tuple[bool, int | None]:
    if os.name == "nt":
        return Path(os.environ.get("SYSTEMROOT", r"C:\Windows"), "System32", "nvcuda.dll").exists(), None
    try:
        version = Path("/proc/driver/nvidia/version").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False, None
    found = re.search(r"\b(\d{3,})\.\d+", version)
    return True, int(found[1]) if found else None


def chosen_compute(machine: Machine, wish: str, available: Iterable[str]) -> tuple[str, str]:
    """What to compute on, and a sentence about it where there is something to say.

    `wish` is automatic, cpu, cuda or apple; `available` are the locks there are. Raises ValueError in a sentence for a
    machine without packages, and for a wish that it cannot fulfil.
    """
    available = set(available)
    if machine.macos is not None and machine.macos < MACOS:
        raise ValueError(f"torch needs macOS {MACOS} or newer, and this is {machine.macos}: update the system")
    if machine.platform == "macos_x86_64":
        raise ValueError(
            "PyTorch is no longer made for Macs with Intel chips (2.2 was the last, and 2.6 is needed): generate on "
            "another computer; a .blend with humans in it opens here and renders in Cycles"
        )
    if not available:
        version = ".".join(map(str, machine.python))
        raise ValueError(
            f"there are no packages for {machine.platform} with Python {version}: "
            "make an environment by hand and name its Python in the preferences"
        )
    if wish == "automatic":
        return _automatic(machine, available)
    if wish not in available:
        found = ", ".join(NAMES[name] for name in sorted(available))
        raise ValueError(f"there are no packages for {NAMES[wish]} here, but for {found}: choose another, or Automatic")
    if wish == "cuda" and not machine.nvidia:
        return wish, "No NVIDIA driver was found: the backend will compute on the CPU until there is one."
    return wish, ""


def _automatic(machine: Machine, available: set[str]) -> tuple[str, str]:
    fallback = "apple" if "apple" in available else "cpu"
    if not machine.nvidia:
        return fallback, ""
    if machine.driver is not None and machine.driver < CUDA_DRIVER:
        return fallback, f"The NVIDIA driver {machine.driver} is too old for CUDA: {CUDA_DRIVER} or newer is needed."
    if "cuda" not in available:
        return fallback, "No CUDA packages of known hashes exist for this Blender: the CPU is used (see the manual)."
    return "cuda", ""


_WHAT_WENT_WRONG = (
    (
        r"DO NOT MATCH THE HASHES.*?\n\s+(\S+)[^\n]*\n\s+Expected sha256",
        "the file of {0} is not the right one (its hash differs) and was not installed: try again, or ask who runs "
        "your package mirror",
    ),
    (r"No space left on device|\[Errno 28\]|WinError 112", "the disk is full: free some space, then try again"),
    (
        r"CERTIFICATE_VERIFY_FAILED|SSLError",
        "the package index's certificate is not trusted: set PIP_CERT, then try again",
    ),
    (
        r"Failed to establish a new connection|Temporary failure in name resolution|getaddrinfo failed|"
        r"nodename nor servname|Network is unreachable|ReadTimeoutError|ConnectTimeoutError|ProxyError|"
        r"Connection(?:Reset|Aborted)Error|IncompleteRead",
        "the package index cannot be reached: check the network and the proxy, then try again",
    ),
    (
        r"No matching distribution found for (\S+)",
        "there is no {0} for this Python and system: check the network and your pip settings",
    ),
)


def clean_environment(temporary: Path, pip_cache: Path) -> dict[str, str]:
    """For pip and venv: nothing of a user's Python set-up, pip's own settings (mirror, proxy, certificate) stay."""
    environment = passed_on(NETWORK)
    environment.update(PIP_USER="0", PIP_CACHE_DIR=str(pip_cache), PYTHONUTF8="1", PYTHONUNBUFFERED="1")
    environment.update(TMPDIR=str(temporary), TEMP=str(temporary), TMP=str(temporary))
    return environment


def followed(
    command: Sequence[str], log: Path, environment: Mapping[str, str], explain: Callable[[str, int], str]
) -> Generator[str, None, None]:
    """Run a command whose output is added to the log, and yield its output so far while it runs; closing ends it.

    Raises RuntimeError with what `explain` makes of the output and the exit code of a command that fails.
    """
    with log.open("ab") as output:
        output.write(f"$ {' '.join(command)}\n".encode())
        output.flush()
        start = output.tell()
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=dict(environment),
                cwd=log.parent,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError as error:
            raise RuntimeError(f"{command[0]} cannot be run: {error.strerror}") from error
    try:
        while (exit_code := process.poll()) is None:
            yield _output_since(log, start)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    if exit_code != 0:
        raise RuntimeError(explain(_output_since(log, start), exit_code))


def _output_since(log: Path, start: int) -> str:
    with log.open("rb") as file:
        file.seek(start)
        return file.read().decode("utf-8", "replace")


def what_went_wrong(output: str, exit_code: int) -> str:
    """pip's failure in a sentence: a known cause with what to do, otherwise its own last error."""
    for pattern, sentence in _WHAT_WENT_WRONG:
        if found := re.search(pattern, output, re.DOTALL):
            return sentence.format(*(group.split("==")[0] for group in found.groups() or ("",)))
    errors = re.findall(r"^ERROR: (.+)$", output, re.MULTILINE) or [
        line for line in output.splitlines() if line.strip()
    ]
    return f"pip failed: {errors[-1].strip() if errors else f'exit code {exit_code}'}"
