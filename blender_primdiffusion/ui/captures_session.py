"""The running capture, one at a time: another Blender, so that this one stays responsive."""

from __future__ import annotations

import collections
import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..backend.child_process import BLENDER, COMPUTING, Output, passed_on
from ..capture import launch
from ..capture.command import MARK
from ..console import CANCELLED, DONE
from ..files.json_files import parse_message
from ..files.regular_files import remove_folder
from ..formats.answers import CapturesProgress
from ..formats.schema import read

PATIENCE_S = 0.7
"""After this a child that was asked to stop is killed: its views are written whole or not at all."""
_MOST_LINES = 200


class CaptureSession:
    """Starts the child, follows it, ends it. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self.error = ""
        """Why the last run failed; empty when it went well."""
        self.notice = ""
        """How the last run ended otherwise."""
        self.message = ""
        self.fraction = 0.0
        self.eta_s: float | None = None
        self._fault = ""
        self.lines: collections.deque[str] = collections.deque(maxlen=_MOST_LINES)
        """Lines of the child, newest last."""
        self.exit_code: int | None = None
        """The last run's exit code."""
        self._process: subprocess.Popen[bytes] | None = None
        self._output: Output | None = None
        self._errors: Output | None = None
        self._folder: Path | None = None
        self._asked_to_stop_at: float | None = None

    @property
    def busy(self) -> bool:
        """A child is running."""
        return self._process is not None

    def new_folder(self) -> Path:
        """A folder for files of the next run, removed when it ends."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="primdiffusion_captures_"))
        return self._folder

    def start(self, words: Sequence[str]) -> None:
        """Begin a run of the command `capture`. Raises ValueError while one runs, OSError where no Blender starts."""
        if self.busy:
            raise ValueError("captures are being rendered; wait for them or press Cancel")
        folder = str(self.new_folder())
        self.error = self.notice = self._fault = ""
        self.message, self.fraction, self.eta_s, self.exit_code = "Starting Blender", 0.0, None, None
        self.lines.clear()
        self._asked_to_stop_at = None
        self._output, self._errors = Output(), Output()
        try:
            self._process = subprocess.Popen(
                [*child_command(), *words, "--progress", "json", "--while-stdin"],
                stdin=subprocess.PIPE,
                stdout=self._output.target,
                stderr=self._errors.target,
                env={**passed_on(COMPUTING, BLENDER), "TMPDIR": folder, "TEMP": folder, "TMP": folder},
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        except OSError:
            self._close_streams()
            raise

    def tick(self) -> bool:
        """Process the child's output; True when something visible changed. Never waits."""
        if self._process is None:
            return False
        before = (self.message, self.fraction, len(self.lines), self.busy)
        exit_code = self._process.poll()  # before reading: then all that it wrote is there
        self._listen()
        asked = self._asked_to_stop_at
        if asked is not None and time.monotonic() - asked > PATIENCE_S:
            self._process.kill()
        if exit_code is not None and self._output.at_end:
            self._finish(exit_code)
        return before != (self.message, self.fraction, len(self.lines), self.busy)

    def cancel(self) -> None:
        """Ask the child to stop; it ends within a second. Rendered views stay, and the next run resumes there."""
        if self._process is None or self._asked_to_stop_at is not None:
            return
        self._asked_to_stop_at = time.monotonic()
        self.message, self.eta_s = "Cancelling", None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def close(self) -> None:
        """Kill the child: the extension is being disabled, or another file is loaded."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            self._close_streams()
        self._clear_folder()

    def _listen(self) -> None:
        for line in self._output.lines():
            self._take(line.decode("utf-8", "replace"))

    def _take(self, line: str) -> None:
        if not line.startswith(MARK):
            return  # printed by Blender
        try:
            progress = read(CapturesProgress, parse_message(line[len(MARK) :]))
        except ValueError as fault:
            self._fault = f"Blender was ended because it sent a malformed message ({fault}): render again"
            self._process.kill()
            return
        if progress.line is not None:
            self.lines.append(progress.line)
            return
        self.lines.extend(progress.news)
        if self._asked_to_stop_at is None:
            self.fraction, self.eta_s = progress.done / max(progress.total, 1), progress.eta_s
            self.message = f"{progress.subject}: view {progress.done} of {progress.total}"

    def _finish(self, code: int) -> None:
        self.exit_code, stopped = code, self._asked_to_stop_at is not None
        complaints = self._errors.log()
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        self._process = None
        self._close_streams()
        self._clear_folder()
        last = self.lines[-1] if self.lines else ""
        if self._fault and not stopped:
            self.error = self._fault
        elif stopped or code == CANCELLED:
            self.notice = "Cancelled; the same settings resume from here."
        elif code == DONE:
            self.notice, self.fraction = last, 1.0
        else:
            said = [line for line in complaints if line.startswith("capture: ")]
            self.error = said[-1].removeprefix("capture: ") if said else last or f"Blender ended with code {code}"

    def _close_streams(self) -> None:
        self._output.close()
        self._errors.close()
        self._output = self._errors = None

    def _clear_folder(self) -> None:
        if self._folder is not None:
            remove_folder(self._folder, self._folder.parent)
            self._folder = None


def child_command() -> list[str]:
    """The command that starts a Blender for captures, without its options."""
    script = str(Path(launch.__file__).resolve())
    if bpy.app.binary_path:
        return [bpy.app.binary_path, "-b", "--factory-startup", "--python", script, "--"]
    return [sys.executable, script, "--"]


captures = CaptureSession()
"""One for all windows."""
