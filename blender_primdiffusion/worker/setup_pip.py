"""Commands of a set-up, venv and pip: run, followed, and their failures in a sentence each."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path

_WHAT_WENT_WRONG = (
    (
        r"DO NOT MATCH THE HASHES.*?\n\s+(\S+)[^\n]*\n\s+Expected sha256",
        "the file of {0} is not the right one (its hash differs) and was not installed: try again, or ask who runs "
        "your package mirror or made your folder of wheels",
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
        "there is no {0} for this Python and system: check the network and your pip settings, or, for Install from "
        "Folder, fetch the wheels with 'pip download' (see the manual)",
    ),
)


class SetUpFailed(RuntimeError):
    """The environment was not finished; the message is one sentence for the user."""


def clean_environment(temporary: Path, pip_cache: Path) -> dict[str, str]:
    """For pip and venv: nothing of a user's Python set-up, pip's own settings (mirror, proxy, certificate) stay."""
    unwanted = ("PYTHON", "VIRTUAL_ENV", "__PYVENV", "CONDA", "PIP_TARGET", "PIP_PREFIX")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(unwanted)}
    environment.update(PIP_USER="0", PIP_CACHE_DIR=str(pip_cache), PYTHONUTF8="1", PYTHONUNBUFFERED="1")
    environment.update(TMPDIR=str(temporary), TEMP=str(temporary), TMP=str(temporary))
    return environment


def followed(
    command: Sequence[str], log: Path, environment: Mapping[str, str], explain: Callable[[str, int], str]
) -> Generator[str, None, None]:
    """Run a command whose output is added to the log, and yield what it has said so far while it runs; closing ends it.

    Raises SetUpFailed with what `explain` makes of the output and the exit code of a command that fails.
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
            raise SetUpFailed(f"{command[0]} cannot be run: {error.strerror}") from error
    try:
        while (exit_code := process.poll()) is None:
            yield _said(log, start)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    if exit_code != 0:
        raise SetUpFailed(explain(_said(log, start), exit_code))


def _said(log: Path, start: int) -> str:
    with log.open("rb") as file:
        file.seek(start)
        return file.read().decode("utf-8", "replace")


def what_went_wrong(said: str, exit_code: int) -> str:
    """pip's failure in a sentence: a known cause with what to do, otherwise its own last error."""
    for pattern, sentence in _WHAT_WENT_WRONG:
        if found := re.search(pattern, said, re.DOTALL):
            return sentence.format(*(group.split("==")[0] for group in found.groups() or ("",)))
    errors = re.findall(r"^ERROR: (.+)$", said, re.MULTILINE) or [line for line in said.splitlines() if line.strip()]
    return f"pip failed: {errors[-1].strip() if errors else f'exit code {exit_code}'}"
