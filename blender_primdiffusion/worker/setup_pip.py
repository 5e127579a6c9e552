"""pip as we run it: only named wheels of known hashes, nothing built; its failures in a sentence each."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from .setup_folder import SetUpFolder, bytes_of
from .setup_locks import Lock, Package

OLDEST_PIP = (22, 3)
"""Knows --python, manylinux_2_28 and hash checking."""
TICK_S = 0.5
_OPTIONS = ("--disable-pip-version-check", "--no-input", "--no-color")
_WHEELS_ONLY = ("--no-deps", "--require-hashes", "--only-binary", ":all:", "--progress-bar", "off")
_WHAT_WENT_WRONG = (
    (
        r"DO NOT MATCH THE HASHES.*?\n\s+(\S+)[^\n]*\n\s+Expected sha256",
        "the downloaded file of {0} is not the right one (its hash differs) and was not installed: try again, or ask "
        "who runs your package mirror",
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
        "the package index cannot be reached: check the network and the proxy, then try again, "
        "or use Install from Folder",
    ),
    (
        r"No matching distribution found for (\S+)",
        "{0} is not on the package index for this Python and system: check the network and your pip settings",
    ),
)


class SetUpFailed(RuntimeError):
    """The environment was not finished; the message is one sentence for the user."""


def clean_environment(temporary: Path) -> dict[str, str]:
    """For pip and venv: nothing of a user's Python set-up, pip's own settings (mirror, proxy, certificate) kept."""
    unwanted = ("PYTHON", "VIRTUAL_ENV", "__PYVENV", "CONDA")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(unwanted)}
    environment.update(PIP_USER="0", PIP_TARGET="", PIP_PREFIX="", PYTHONUTF8="1", PYTHONUNBUFFERED="1")
    environment.update(TMPDIR=str(temporary), TEMP=str(temporary), TMP=str(temporary))
    return {name: value for name, value in environment.items() if value or name not in ("PIP_TARGET", "PIP_PREFIX")}


class Pip:
    """pip for one environment: its own, or that of the Python that made it."""

    def __init__(self, command: Sequence[str], folder: SetUpFolder, log: IO[str]):
        self._command, self._folder, self._log = tuple(command), folder, log

    def version(self) -> tuple[int, ...]:
        """Raises SetUpFailed when this pip does not run."""
        said = "".join(self._lines(["--version"]))
        found = re.search(r"pip (\d+)\.(\d+)", said)
        return (int(found[1]), int(found[2])) if found else (0, 0)

    def download(self, packages: Sequence[Package], lock: Lock, into: Path) -> Iterator[int]:
        """Fetches wheels, yields the bytes that are there so far, several times a second. Raises SetUpFailed."""
        extra = [option for index in lock.indexes for option in ("--extra-index-url", index)]
        indexes = extra if any("+" in package.version for package in packages) else []  # builds that PyPI has not
        arguments = ["download", *_WHEELS_ONLY, "--no-cache-dir", "-d", str(into), *indexes]
        for _ in self._lines([*arguments, "-r", str(self._requirements(packages))]):
            yield bytes_of(into) + bytes_of(self._folder.temporary)

    def install(self, packages: Sequence[Package], wheels: Path) -> None:
        """Unpacks wheels of a folder, checking their hashes once more. Raises SetUpFailed.

        Byte code is not compiled here: the child keeps it in the extension's cache.
        """
        arguments = ["install", *_WHEELS_ONLY, "--no-index", "--find-links", str(wheels), "--no-compile"]
        arguments += ["--no-warn-script-location", "--no-cache-dir"]
        for _ in self._lines([*arguments, "-r", str(self._requirements(packages))]):
            pass

    def _requirements(self, packages: Sequence[Package]) -> Path:
        path = self._folder.temporary / "wanted.txt"
        path.write_text("\n".join(package.requirement for package in packages) + "\n", encoding="utf-8")
        return path

    def _lines(self, arguments: Sequence[str]) -> Iterator[str]:
        """What pip says, line by line; an empty string at every tick, so that its caller can look around."""
        yield from said_by([*self._command, *arguments[:1], *_OPTIONS, *arguments[1:]], self._folder, self._log)


def said_by(command: Sequence[str], folder: SetUpFolder, log: IO[str]) -> Iterator[str]:
    """Runs a command; its output also goes to the log. Raises SetUpFailed with what went wrong."""
    log.write(f"$ {' '.join(command)}\n")
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=clean_environment(folder.temporary),
            cwd=folder.root,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise SetUpFailed(f"{command[0]} cannot be run: {error.strerror}") from error
    lines: list[str] = []
    reader = threading.Thread(target=_collect, args=(process.stdout, lines), daemon=True)
    reader.start()
    told = 0
    while reader.is_alive() or told < len(lines):
        reader.join(TICK_S)
        yield from lines[told:] or [""]
        log.writelines(lines[told:])
        log.flush()
        told = len(lines)
    if process.wait() != 0:
        raise SetUpFailed(what_went_wrong("".join(lines), process.returncode))


def _collect(stdout: IO[bytes], lines: list[str]) -> None:
    for line in stdout:
        lines.append(line.decode("utf-8", "replace"))


def what_went_wrong(said: str, exit_code: int) -> str:
    """pip's failure in a sentence: a known cause with what to do, otherwise its own last error."""
    for pattern, sentence in _WHAT_WENT_WRONG:
        if found := re.search(pattern, said, re.DOTALL):
            return sentence.format(*(group.split("==")[0] for group in found.groups() or ("",)))
    errors = re.findall(r"^ERROR: (.+)$", said, re.MULTILINE) or [line for line in said.splitlines() if line.strip()]
    return f"pip failed: {errors[-1].strip() if errors else f'exit code {exit_code}'}"


def sha256_of(path: Path) -> str:
    """Of a file. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
