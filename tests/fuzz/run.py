"""Feed damaged files to their readers, in a process that is watched, and count what comes of it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
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
import psutil

LONGEST_SENTENCE = 300
"""Characters without the folder of the file, which is the user's."""
LONGEST_TOTAL_CPU_S, LONGEST_WALL_S = 30.0, 180.0
"""After so much work, or so long a silence, the process is ended: what waits for ever works on nothing."""
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

    def find(self, what: str) -> None:
        """Keep a finding, and print it."""
        self.findings.append(what)
        print(what, flush=True)

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
        heard, worked, rest = time.monotonic(), 0.0, b""
        loads = True  # torch and bpy, or what is not damaged
        while True:
            text = child.stdout.read() or b""
            *lines, rest = (rest + text).split(b"\n")
            for message in map(json.loads, lines):
                heard, worked, loads = time.monotonic(), _cpu_s(child.pid), "loads" in message
                now = message["number"]
                if "outcome" in message:
                    now += 1
                    report.counts["inputs"] += 1
                    _note(report, message)
            over = end is not None and time.monotonic() > end
            silent = time.monotonic() - heard > LONGEST_WALL_S * (1 + loads)
            if over or silent or child.poll() is not None:
                break
            if not loads and _cpu_s(child.pid) - worked > LONGEST_TOTAL_CPU_S:
                break
            time.sleep(0.05)
        ended = child.poll()
        child.kill()
    if over or ended == 0:
        return now
    if loads and ended is not None:
        raise RuntimeError(f"input {now}: the process ended ({ended}) before a damaged file was read")
    report.counts["inputs"] += 1
    outcome = "hangs" if ended is None else "tracebacks"
    report.counts[outcome] += 1
    report.find(f"{outcome}: seed {seed}, input {now}{f' of {only}' if only else ''}: the process ended ({ended})")
    return now + 1


def _note(report: Report, message: dict[str, Any]) -> None:
    for outcome in message["outcome"]:
        report.counts[outcome] += 1
        if outcome not in ("read", "sentences"):
            report.find(f"{outcome}: {message['what']}")


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
    from fuzz.target import in_turn
    from fuzz.targets import TARGETS

    events: list[str] = []
    sys.addaudithook(lambda event, _: events.append(event) if event in PROGRAMS else None)
    targets = in_turn([target for target in TARGETS if only in target.name])
    with tempfile.TemporaryDirectory() as temporary:
        os.chdir(temporary)
        valid: dict[str, tuple[Path, bytes]] = {}
        for number in range(first, last):
            target = targets[number % len(targets)]
            if target.name not in valid:
                _say(number=number, loads=True)
                folder = Path(temporary, str(number))
                folder.mkdir()
                path = target.make(folder)
                target.read(path)  # what is not damaged is read
                valid[target.name] = path, path.read_bytes()
            path, content = valid[target.name]
            _say(number=number)
            path.write_bytes(damaged(target, content, seed, number))
            what = f"{target.name}, seed {seed}, input {number}"
            events.clear()
            outcome, about = _outcome(target, path)
            if set(outcome) & {"hangs", "over_500mb"}:  # once more alone: another program may have slowed it down
                outcome, about = _outcome(target, path)
            if events or Path("CANARY").exists():
                outcome.append("executions")
                about += f" ({events})"
            what += f": {about}"
            if set(outcome) - {"read", "sentences"}:
                FINDINGS.mkdir(exist_ok=True)
                (FINDINGS / f"{target.name.replace(' ', '_')}_{seed}_{number}{path.suffix}").write_bytes(
                    path.read_bytes()
                )
            path.write_bytes(content)
            _say(number=number, outcome=outcome, what=what)


def _outcome(target: Any, path: Path) -> tuple[list[str], str]:
    """What came of reading a damaged file, and more about it."""
    from fuzz.target import Garbage, said

    outcome, about = ["read"], ""
    before, memory = time.process_time(), _memory_mb("VmRSS")
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    try:
        target.read(path)
    except Garbage as error:
        outcome, about = ["garbage"], str(error)
    except Exception as error:
        sentence = said(error)
        if sentence is None:
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            outcome, about = ["tracebacks"], f"{type(error).__name__}: {str(error)[:150]} ({place})"
        else:
            outcome, about = ["sentences"], sentence
            if fault := _fault_of(sentence, path, target.is_file):
                outcome, about = ["tracebacks"], f"{fault}: {sentence}"
        if _asked_for_too_much(error):
            outcome, about = [*outcome, "over_500mb"], f"{about} (more than this process may have)"
    seconds, grown = time.process_time() - before, _memory_mb("VmHWM") - memory
    if seconds > target.seconds:
        outcome, about = [*outcome, "hangs"], f"{about} ({seconds:.1f} s)"
    if grown > MOST_MEMORY_MB:
        outcome, about = [*outcome, "over_500mb"], f"{about} ({grown:.0f} MB)"
    return outcome, about


def _asked_for_too_much(error: BaseException | None) -> bool:
    """Whether memory was refused to the reader, whatever it made of that."""
    while error is not None:
        if isinstance(error, MemoryError) or "allocate memory" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _fault_of(sentence: str, path: Path, is_file: bool) -> str:
    """What is wrong with the sentence for a damaged file; empty if nothing."""
    length = len(sentence.replace(f"{path.parent}{os.sep}", ""))
    if length > LONGEST_SENTENCE or "\n" in sentence:
        return f"a sentence of {length} characters"
    if is_file and not any(name in sentence for name in (path.name, str(path.parent))):
        return "a sentence without the file"
    return ""


def _say(**message: Any) -> None:
    sys.__stdout__.write(json.dumps(message) + "\n")  # pyright: ignore[reportOptionalMemberAccess]
    sys.__stdout__.flush()  # pyright: ignore[reportOptionalMemberAccess]


def _memory_mb(kind: str) -> float:
    """Memory of this process now (VmRSS) or its peak (VmHWM); 0 on other systems than Linux."""
    if sys.platform != "linux":
        return 0.0
    (kilobytes,) = re.findall(rf"^{kind}:\s+(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(kilobytes) / 1024


def _cpu_s(pid: int) -> float:
    with contextlib.suppress(psutil.Error):
        return sum(psutil.Process(pid).cpu_times()[:2])
    return 0.0


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_DATA, (8 * 2**30,) * 2)
    import bpy  # noqa: F401  before the rest, which it would otherwise load anew

    _serve(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
