"""Deaths and stops of the child under the extension's real client: each request ends, and the next one works."""

from __future__ import annotations

import itertools
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
from chaos.kills import Tally
from chaos.results import leftovers
from support import tensor_files
from support.fake_child import DIES, FAKE_CHILD

from blender_primdiffusion.backend.client import BackendClient, Silent
from blender_primdiffusion.backend.requests import Backend, ChildRequest

SEED = 10
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM, signal.SIGABRT)
TICK_S = 0.01
HANG_S = 60.0
"""A request that has not ended by then hangs."""
LATEST_S, LATEST_WARM_S = 0.5, 0.15
"""After the start of a request, the time by which a new or a warm child dies: while it starts, works, or has
finished."""
NOTICED_S = 15.0
"""Of silence, after which the client gives up a child; in Blender it is 20 s."""


class Deaths:
    """Requests to a child that dies, of one `Backend`."""

    def __init__(self, folder: Path, rng: random.Random) -> None:
        self._folder, self._rng = folder, rng
        self._numbers = itertools.count()
        self._human = folder / "person.human.safetensors"
        tensor_files.write_tensors(self._human, {}, {"provenance": "{}"})
        (folder / tensor_files.BODY).write_bytes(b"a body")
        self._backend = Backend(self._fake)
        self.tally = Tally()
        self.hangs = 0

    def _fake(self) -> BackendClient:
        human = {"FAKE_HUMAN": str(self._human)}
        return BackendClient(Path(sys.executable), FAKE_CHILD, human, silence_s=NOTICED_S)

    def killed(self) -> None:
        """A request whose child dies at a random time, by a random signal or by itself."""
        rng = self._rng
        number = rng.choice(SIGNALS)
        at = self._moment()
        request = self._generate(DIES if rng.random() < 0.1 else SEED)
        died = self._until(request, lambda: self._send(number), at)
        self._judge(request, ("done", "failed"), f"signal {number} after {at:.2f} s", died or request.state == "failed")

    def killed_between_requests(self) -> None:
        """A warm child that dies while it has nothing to do."""
        request = self._generate(SEED)
        self._until(request)
        self._judge(request, ("done",), "before an idle child is killed", died=False)
        self._send(signal.SIGKILL)
        while self._backend.client is not None:
            time.sleep(TICK_S)
        self._judge_next("an idle child was killed", died=True)

    def stopped(self) -> None:
        """A child that is stopped (SIGSTOP) at a random time, and never goes on."""
        at = self._moment()
        request = self._generate(SEED)
        stopped = self._until(request, lambda: self._send(signal.SIGSTOP), at)
        self._judge(request, ("done", "failed"), f"stopped after {at:.2f} s", died=False)
        if request.state == "failed" and "hung" not in request.message:
            self.tally.add(0, [f"the message is {request.message!r}"], "a stopped child")
        if request.state == "done" and stopped:
            self._idle_silence()

    def stopped_and_cancelled(self) -> None:
        """A child that is stopped in the middle of a request, which is then cancelled."""
        at, request = self._moment(), self._generate(SEED)

        def act() -> bool:
            if not self._send(signal.SIGSTOP):
                return False
            request.cancel()
            return True

        stopped = self._until(request, act, at)
        self._judge(request, ("done", "cancelled"), "stopped and cancelled", died=False)
        if request.state == "done" and stopped:
            self._idle_silence()

    def stopped_and_continued(self) -> None:
        """A child that is stopped for a moment goes on."""
        request = self._generate(SEED)
        self._until(request, lambda: self._send(signal.SIGSTOP), 0.1, leave=True)
        end = time.monotonic() + NOTICED_S / 4
        while time.monotonic() < end:
            request.tick()
            time.sleep(TICK_S)
        self._send(signal.SIGCONT)
        self._until(request)
        self._judge(request, ("done",), "stopped for a moment", died=False)

    def works(self) -> None:
        """Ask for a human, and expect it."""
        self._judge_next("an undisturbed request", died=False)

    def end(self) -> None:
        """End the child; no process and no file may stay."""
        self._backend.shutdown()
        self.tally.add(0, [f"process {child.pid} was left over" for child in _children()], "at the end")

    def _moment(self) -> float:
        return self._rng.uniform(0, LATEST_S if self._backend.client is None else LATEST_WARM_S)

    def _generate(self, seed: int) -> ChildRequest:
        out = self._folder / f"out{next(self._numbers)}"
        return ChildRequest(self._backend, "generate", {"seed": seed, "steps": 4, "out_dir": str(out)})

    def _send(self, number: int) -> bool:
        client = self._backend.client
        if client is None or client.pid is None:
            return False
        os.kill(client.pid, number)
        return True

    def _until(
        self, request: ChildRequest, act: Callable[[], object] | None = None, at: float = 0.0, leave: bool = False
    ) -> bool:
        """Tick a request to its end; `act` after so many seconds, and then return if `leave`. Whether it acted."""
        began, acted = time.monotonic(), False
        while not request.finished and time.monotonic() - began < HANG_S:
            request.tick()
            if act is not None and not acted and time.monotonic() - began > at:
                acted = act() is not False
                if acted and leave:
                    return True
            time.sleep(TICK_S)
        return acted

    def _judge(self, request: ChildRequest, states: tuple[str, ...], where: str, died: bool) -> None:
        wrong = []
        if not request.finished:
            self.hangs += 1
            wrong.append(f"the request hangs in state {request.state}")
            self._backend.shutdown()
            self._backend = Backend(self._fake)
        elif request.state not in states:
            wrong.append(f"the request is {request.state}: {request.message}")
        if request.state == "failed" and (request.error is None or not request.error.message):
            wrong.append("it failed without a message")
        self._backend.reap()
        wrong += [f"{name} was left over" for name in leftovers(self._folder)]
        self.tally.add(int(died), wrong, where)

    def _judge_next(self, where: str, died: bool) -> None:
        request = self._generate(SEED)
        self._until(request)
        self._judge(request, ("done",), f"the request after {where}", died)

    def _idle_silence(self) -> None:
        """A child that is stopped between requests is noticed, and ended as the extension's queue does."""
        end = time.monotonic() + HANG_S
        while time.monotonic() < end:
            if any(isinstance(event, Silent) for event in self._backend.listen()):
                self._backend.release()
                return
            time.sleep(TICK_S)
        self.hangs += 1
        self.tally.add(0, ["nothing was said of it"], "a child that was stopped while idle")


def _children() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "primdiffusion.serve" in " ".join(_words(child))]


def _words(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []
