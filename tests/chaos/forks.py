"""Command lines of the backend in processes forked from one that has imported it, so that each starts at once.

`python -m chaos.forks` reads one JSON object per line: `arguments` of `primdiffusion`, `small`
(the test module that makes its settings small), `death` (see `Death`), `file_limit` and `request`. It answers with the
process's id, and at its end with `Ended`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
FOLDERS = (TESTS.parent, TESTS.parent / "backend", TESTS, TESTS / "backend", TESTS / "contract", TESTS / "blender")
"""In which a process finds this package, the backend and the helper modules of tests."""
WRITING = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate", "shutil.rmtree")
COUNTED = "operations of the process: "


@dataclasses.dataclass(frozen=True)
class Death:
    """How a process ends before its time; one of the fields is given."""

    seconds: float | None = None
    """SIGKILL from outside, so long after its start."""
    operation: int | None = None
    """SIGKILL before this change of the file system: the n-th file opened for writing, renamed, removed, ..."""
    size: int | None = None
    """The system kills it in the middle of a write, when a file reaches this size in bytes."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """A process that has ended."""

    exit_code: int
    """Negative: the signal that killed it."""
    log: str
    seconds: float
    operations: int
    """Changes of the file system that it has counted, if it was not killed."""


class Forks:
    """The process that forks. Close it at the end."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, "-m", "chaos.forks"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, FOLDERS)), "OMP_NUM_THREADS": "1"},
        )

    def run(
        self,
        arguments: Sequence[str | Path],
        small: str = "",
        death: Death | None = None,
        file_limit: int | None = None,
        request: Mapping[str, Any] | None = None,
    ) -> Ended:
        """Run a command line to its end, or to its death. Writing beyond `file_limit` bytes of a file fails.

        `request` of JSON-RPC is what `serve` is asked; it ends with the answer, and exit code 1 for an error.
        """
        death = death or Death()
        began = time.monotonic()
        pid = self._ask(
            arguments=[str(argument) for argument in arguments],
            small=small,
            death=dataclasses.asdict(death),
            file_limit=file_limit,
            request=request,
        )
        if death.seconds is not None:
            time.sleep(death.seconds)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return Ended(**self._answer(), seconds=time.monotonic() - began)

    def close(self) -> None:
        """End the process that forks."""
        assert self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait(30)

    def _ask(self, **request: Any) -> int:
        """The process's id."""
        assert self._server.stdin is not None
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self._server.stdout is not None
        line = self._server.stdout.readline()
        if not line:
            raise RuntimeError(f"the process that forks has ended ({self._server.poll()})")
        return json.loads(line)


@contextlib.contextmanager
def forking() -> Iterator[Forks]:
    """`Forks`, closed at the end."""
    forks = Forks()
    try:
        yield forks
    finally:
        forks.close()


def random_death(rng: random.Random, whole: Ended, largest: int, share: float = 1.0) -> Death:
    """A moment between the start and the end of a run that took `whole`, whose largest file has `largest` bytes.

    Three of four are where files change: between two changes, as before a rename, or in the middle of a write. `share`
    of a run is left to one that goes on from another.
    """
    kind = rng.choice(("seconds", "operation", "operation", "size"))
    if kind == "seconds":
        return Death(seconds=rng.uniform(0, share * whole.seconds))
    if kind == "operation":
        return Death(operation=rng.randint(1, max(round(share * whole.operations), 1)))
    return Death(size=round(2 ** rng.uniform(0, (largest + 1).bit_length())))


def _serve() -> None:
    _import_all()
    for line in sys.stdin:
        request = json.loads(line)
        output, written = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(output)
            _run(written, **request)
        os.close(written)
        print(pid, flush=True)
        with open(output, encoding="utf-8", errors="replace") as file:
            log = file.read()  # until its worker processes have ended, too
        _, status = os.waitpid(pid, 0)
        log, _, count = log.partition(COUNTED)
        ended = {"exit_code": os.waitstatus_to_exitcode(status), "log": log, "operations": int(count or 0)}
        print(json.dumps(ended), flush=True)


def _import_all() -> None:
    import importlib

    from primdiffusion.cli import PROGRAMS
    from primdiffusion.commands import FUNCTIONS
    from primdiffusion.runtime.machine import share_processors

    share_processors()
    lazily = ("commands.session", "commands.output", "commands.frame_drawer", "people.folder", "people.payloads",
              "people.assets", "encoder.model", "training.captured_people", "training.refine", "export.proxy",
              "export.gaussians", "export.merged_file", "capture.dataset", "capture.sheet",
              "render.march")  # fmt: skip
    verbs = {f"commands.{place.partition(':')[0]}" for place in FUNCTIONS.values()}
    for module in (*verbs, *PROGRAMS.values(), *lazily):
        importlib.import_module(f"primdiffusion.{module}")
    optimisers = ("torch._dynamo", "torch.distributed.fsdp", "torch.fx.experimental.symbolic_shapes")
    for module in ("diffuse_runs", "fit_scenes", *optimisers):
        importlib.import_module(module)
    _use_a_kernel()


def _use_a_kernel() -> None:
    """Let numba set itself up."""
    import numpy as np
    from primdiffusion.capture.reader import Window, resample

    resample(np.zeros((2, 2, 4), np.uint8), Window(0, 0, 2, 2), 1)


def _run(
    output: int,
    arguments: list[str],
    small: str,
    death: dict[str, Any],
    file_limit: int | None,
    request: dict[str, Any] | None,
) -> None:
    """In the forked process: never returns."""
    code = 70
    try:
        for descriptor in (1, 2):
            os.dup2(output, descriptor)
        sys.stdin = open(os.devnull)  # noqa: SIM115
        os.dup2(sys.stdin.fileno(), 0)
        if small:
            _make_small(small)
        operations = _prepare_death(Death(**death))
        if file_limit is not None:
            _limit_files(file_limit)
        if request is not None:
            _ask_server(request, output, operations)
        code = _main(arguments)
        sys.stderr.flush()
        print(f"{COUNTED}{len(operations)}")
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _ask_server(request: dict[str, Any], output: int, operations: list[int]) -> None:
    """Let `serve` find a client on descriptors 0 and 1, which asks, and ends the process with the answer."""
    questions, asked = os.pipe()
    answered, answers = os.pipe()
    os.dup2(questions, 0)
    os.dup2(answers, 1)
    with open(os.devnull, "w") as nothing:  # tracebacks of errors that are sentences for the user
        os.dup2(nothing.fileno(), 2)

    def converse() -> None:
        with open(answered, encoding="utf-8") as lines:
            for message in map(json.loads, lines):
                if message.get("id") != 1:
                    continue
                error = message.get("error")
                if error is not None:
                    sentence = ": ".join(filter(None, (error["message"], error.get("data", {}).get("remedy"))))
                    os.write(output, f"primdiffusion: {sentence}\n".encode())
                os.write(output, f"{COUNTED}{len(operations)}\n".encode())
                os._exit(int(error is not None))

    threading.Thread(target=converse, daemon=True).start()
    os.write(asked, json.dumps({"jsonrpc": "2.0", "id": 1, **request}).encode() + b"\n")


def _main(arguments: list[str]) -> int:
    from primdiffusion.cli import main

    try:
        main(arguments)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    return 0


def _make_small(name: str) -> None:
    import importlib

    import pytest

    importlib.import_module(name).make_small(pytest.MonkeyPatch())


def _prepare_death(death: Death) -> list[int]:
    """Counts changes of the file system, and ends the process at the given one; or limits the size of files."""
    import resource

    operations: list[int] = []

    def count(event: str, details: tuple[Any, ...]) -> None:
        if event in WRITING or (event == "open" and _writes(details)):
            operations.append(1)
            if len(operations) == death.operation:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    if death.size is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        _limit_files(death.size)
    return operations


def _writes(details: tuple[Any, ...]) -> bool:
    path, _, flags = details
    return bool(flags & (os.O_WRONLY | os.O_RDWR)) and path != os.devnull


def _limit_files(size: int) -> None:
    """Files of at most `size` bytes."""
    import resource

    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))


if __name__ == "__main__":
    _serve()
