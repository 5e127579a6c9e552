"""Setting up as Blender follows it: a process of its own, a few attributes for a panel, and `tick`."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
from pathlib import Path
from typing import IO, Any, Literal

from .setup_group import GROUP_FLAGS, end_group
from .setup_process import command
from .setup_steps import Plan

Kind = Literal["set_up", "repair", "self_test", "remove"]
TITLES: dict[str, str] = {
    "set_up": "Setting up the backend",
    "repair": "Repairing the backend",
    "self_test": "Testing the backend",
    "remove": "Removing the backend",
}
CANCELLED = "Cancelled; what has been downloaded is kept, and Set Up Backend goes on from there"


class SetUpJob:
    """One process at work. `start` it, `tick` it from a timer, `cancel` it; nothing here waits."""

    def __init__(self, kind: Kind, plan: Plan):
        self.kind: Kind = kind
        self.plan = plan
        self.state: Literal["running", "done", "failed", "cancelled"] = "running"
        self.message = TITLES[kind]
        self.fraction = 0.0
        self.result: dict[str, Any] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._error = ""

    @property
    def finished(self) -> bool:
        """Nothing more will happen."""
        return self.state != "running"

    @property
    def log(self) -> Path:
        """Where everything that was said is kept."""
        return self.plan.folder.log

    def start(self) -> None:
        """Raises OSError when the plan's Python cannot be run."""
        process = subprocess.Popen(
            command(self.plan.host, self.kind, self.plan),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # passed over on Windows, as the flags are elsewhere
            creationflags=GROUP_FLAGS,
        )
        threading.Thread(target=self._read, args=(process.stdout,), name="set-up", daemon=True).start()
        self._process = process

    def tick(self) -> bool:
        """Takes in what has been said; True when something visible has changed."""
        changed = False
        while not self.finished and not self._lines.empty():
            line = self._lines.get_nowait()
            changed = True
            if line is None:
                self._end()
            else:
                self._take(line)
        return changed

    def cancel(self) -> None:
        """Ends the process and all that it has started, within a moment."""
        if self.finished:
            return
        if self._process is not None:
            end_group(self._process.pid)
            self._process.wait(10.0)
        self.state, self.message = "cancelled", CANCELLED if self.kind == "set_up" else "Cancelled"

    def _take(self, line: bytes) -> None:
        try:
            said = json.loads(line)
        except ValueError:
            return  # not ours: something in the Python of this Blender prints
        if "error" in said:
            self._error = said["error"]
        else:
            self.message, self.fraction, self.result = said["message"], said["fraction"], said["result"]

    def _end(self) -> None:
        exit_code = self._process.wait() if self._process is not None else None
        if exit_code == 0 and self.result is not None:
            self.state = "done"
            return
        self.state = "failed"
        self.message = self._error or f"{TITLES[self.kind]} ended by itself (exit code {exit_code}): see {self.log}"

    def _read(self, stdout: IO[bytes]) -> None:
        for line in stdout:
            self._lines.put(line)
        self._lines.put(None)
