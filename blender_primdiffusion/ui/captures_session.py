"""The running capture, one at a time: another Blender, so that this one stays responsive."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..backend.child_process import BLENDER, COMPUTING, Output, passed_on
from ..backend.requests import Step, Steps
from ..capture import launch
from ..capture.command import MARK
from ..console import DONE, FAILED, duration
from ..files.json_files import parse_message
from ..files.regular_files import remove_folder
from ..formats.answers import CapturesProgress
from ..formats.schema import read
from ..jobs.steps import Session

captures = Session("captures are being rendered", "Cancelled; the same settings resume from here")
"""One for all windows."""


def capturing(words: Sequence[str], folder: Path) -> Steps:
    """Steps of the command `capture`, whose temporary files go to `folder`, which is removed.

    Closing it kills the Blender that renders: its views are written whole or not at all.
    """
    output, errors, process = Output(), Output(), None
    step, said = Step("Starting Blender", 0.0), []
    try:
        process = subprocess.Popen(
            [*child_command(), *words, "--progress", "json", "--while-stdin"],
            stdin=subprocess.PIPE,
            stdout=output.target,
            stderr=errors.target,
            env={**passed_on(COMPUTING, BLENDER), "TMPDIR": str(folder), "TEMP": str(folder), "TMP": str(folder)},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        exit_code = None
        while exit_code is None or not output.at_end:
            exit_code = process.poll()  # before reading: then all that it wrote is there
            for line in output.lines():
                if line.startswith(MARK.encode()):  # others are Blender's
                    step = _step(line.decode("utf-8", "replace")[len(MARK) :], step)
                    said = [*said, *step.lines][-2:]
                    yield step
            yield Step(step.message, step.fraction)
        if exit_code == DONE or (exit_code == FAILED and "--repair" in words):  # what was damaged is mended then
            return said[-1]
        complaints = [line.removeprefix("capture: ") for line in errors.log() if line.startswith("capture: ")]
        raise RuntimeError("; ".join(complaints[-1:] or said) or f"Blender ended with code {exit_code}")
    finally:
        if process is not None:
            process.kill()
            process.wait()
            with contextlib.suppress(OSError):
                process.stdin.close()
        output.close()
        errors.close()
        remove_folder(folder, folder.parent)


def _step(message: str, before: Step) -> Step:
    """What a message of the child says. Raises RuntimeError for a malformed one."""
    try:
        progress = read(CapturesProgress, parse_message(message))
    except ValueError as fault:
        raise RuntimeError(f"Blender was ended because it sent a malformed message ({fault}): render again") from fault
    if progress.line is not None:
        return Step(before.message, before.fraction, (progress.line,))
    left = f" ({duration(progress.eta_s)} left)" if progress.eta_s else ""
    text = f"{progress.subject}: view {progress.done} of {progress.total}{left}"
    return Step(text, progress.done / max(progress.total, 1), tuple(progress.news))


def child_command() -> list[str]:
    """The command that starts a Blender for captures, without its options."""
    script = str(Path(launch.__file__).resolve())
    if bpy.app.binary_path:
        return [bpy.app.binary_path, "-b", "--factory-startup", "--python", script, "--"]
    return [sys.executable, script, "--"]
