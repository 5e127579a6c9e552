"""Feed damaged files to their readers, in a process that is watched, and count what comes of it."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

LONGEST_SENTENCE = 600
"""Characters beside the path; most are far shorter."""
LONGEST_CPU_S, LONGEST_WALL_S = 2.0, 30.0
MOST_MEMORY_MB = 500.0
PROGRAMS = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "subprocess.Popen", "pty.spawn", "socket.connect")
"""Audit events of code that a file has made run."""
ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (ROOT / "tests", *(ROOT / "tests" / name for name in ("backend", "blender", "contract")), ROOT)
FINDINGS = ROOT / "fuzz_out"
"""Failing inputs are kept here."""


@dataclasses.dataclass
class Report:
    """Counts, and a line for each finding."""

    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    findings: list[str] = dataclasses.field(default_factory=list)

    def figures(self) -> dict[str, int]:
        """As benchmarks/faults.py records them."""
        names = ("inputs", "tracebacks", "garbage", "hangs", "over_500mb")
        return {**{f"fuzz_{name}": self.counts[name] for name in names}, "executions": self.counts["executions"]}


def run(seed: int, inputs: int, *, minutes: float | None = None, only: str = "") -> Report:
    """Try `inputs` damaged inputs, or as many as fit into `minutes`; a process that hangs or dies is replaced."""
    report, number, end = Report(), 0, None if minutes is None else time.monotonic() + 60 * minutes
    while (number < inputs) if end is None else (time.monotonic() < end):
        number = _run_child(report, seed, number, inputs if end is None else number + 1_000_000, end, only)
    return report


def _run_child(report: Report, seed: int, first: int, last: int, end: float | None, only: str) -> int:
    """Run one process from input `first` on; returns the number of the input to go on with."""
    line = [sys.executable, "-m", "fuzz.run", str(seed), str(first), str(last), only]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*FOLDERS, ROOT / "backend")))}
    now = first
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as child:
        assert child.stdout is not None
        os.set_blocking(child.stdout.fileno(), False)
        heard, rest = time.monotonic() + 60, b""  # loading torch and bpy takes a while
        while True:
            text = child.stdout.read() or b""
            *lines, rest = (rest + text).split(b"\n")
            for message in map(json.loads, lines):
                heard = time.monotonic()
                now = message["number"]
                if "outcome" in message:
                    now += 1
                    report.counts["inputs"] += 1
                    _note(report, message)
            over = end is not None and time.monotonic() > end
            if over or child.poll() is not None or time.monotonic() - heard > LONGEST_WALL_S:
                break
            time.sleep(0.05)
        ended = child.poll()
        child.kill()
    if over or ended == 0:
        return now
    report.counts["inputs"] += 1
    outcome = "hangs" if ended is None else "tracebacks"
    report.counts[outcome] += 1
    report.findings.append(
        f"{outcome}: seed {seed}, input {now}{f' of {only}' if only else ''}: the process ended ({ended})"
    )
    return now + 1


def _note(report: Report, message: dict[str, Any]) -> None:
    for outcome in message["outcome"]:
        report.counts[outcome] += 1
        if outcome not in ("read", "sentences"):
            report.findings.append(f"{outcome}: {message['what']}")


def damaged(target: Any, content: bytes, seed: int, number: int) -> bytes:
    """Input `number` of a target: the same for the same seed."""
    rng = np.random.default_rng([seed, number])
    for _ in range(1 + int(rng.random() < 0.2)):
        mutation = target.mutations[int(rng.integers(len(target.mutations)))]
        try:
            content = mutation(content, rng)
        except Exception:  # what is damaged already may have no structure left to damage
            return content
    return content


def _serve(seed: int, first: int, last: int, only: str) -> None:
    from fuzz.targets import TARGETS, Garbage, said

    events: list[str] = []
    sys.addaudithook(lambda event, _: events.append(event) if event in PROGRAMS else None)
    targets = [target for target in TARGETS if only in target.name]
    with tempfile.TemporaryDirectory() as temporary:
        os.chdir(temporary)
        valid: dict[str, tuple[Path, bytes]] = {}
        for number in range(first, last):
            target = targets[number % len(targets)]
            if target.name not in valid:
                folder = Path(temporary, str(targets.index(target)))
                folder.mkdir()
                path = target.make(folder)
                target.read(path)  # what is not damaged is read
                valid[target.name] = path, path.read_bytes()
            path, content = valid[target.name]
            _say(number=number)
            path.write_bytes(damaged(target, content, seed, number))
            outcome, what = [], f"{target.name}, seed {seed}, input {number}"
            events.clear()
            before, memory = time.process_time(), _peak_mb()
            try:
                target.read(path)
                outcome.append("read")
            except Garbage as error:
                outcome, what = ["garbage"], f"{what}: {error}"
            except Exception as error:
                sentence = said(error)
                if sentence is None:
                    where = traceback.extract_tb(error.__traceback__)[-1]
                    outcome.append("tracebacks")
                    place = f"{Path(where.filename).name}:{where.lineno}"
                    what = f"{what}: {type(error).__name__}: {str(error)[:150]} ({place})"
                elif len(sentence) > LONGEST_SENTENCE + len(str(path)) or "\n" in sentence:
                    outcome, what = (
                        ["tracebacks"],
                        f"{what}: a sentence of {len(sentence)} characters: {sentence[:150]}",
                    )
                else:
                    outcome.append("sentences")
            if time.process_time() - before > LONGEST_CPU_S:
                outcome.append("hangs")
                what += f" ({time.process_time() - before:.1f} s)"
            if _peak_mb() - memory > MOST_MEMORY_MB:
                outcome.append("over_500mb")
                what += f" ({_peak_mb() - memory:.0f} MB)"
            if events or Path("CANARY").exists():
                outcome.append("executions")
                what += f" ({events})"
            if set(outcome) - {"read", "sentences"}:
                FINDINGS.mkdir(exist_ok=True)
                (FINDINGS / f"{target.name.replace(' ', '_')}_{seed}_{number}{path.suffix}").write_bytes(
                    path.read_bytes()
                )
            path.write_bytes(content)
            _say(number=number, outcome=outcome, what=what)


def _say(**message: Any) -> None:
    sys.__stdout__.write(json.dumps(message) + "\n")  # pyright: ignore[reportOptionalMemberAccess]
    sys.__stdout__.flush()  # pyright: ignore[reportOptionalMemberAccess]


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_DATA, (8 * 2**30,) * 2)
    import bpy  # noqa: F401  before the rest, which it would otherwise load anew

    _serve(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
