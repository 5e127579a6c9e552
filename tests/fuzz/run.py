"""Feed damaged files to their readers, in processes that are watched, and count what comes of it."""

from __future__ import annotations

import concurrent.futures
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from fuzz.findings import CASES, folder_of, keep, shrunk

ROOT = Path(__file__).resolve().parents[2]
LONGEST_SENTENCE = 300
"""Characters without the folder of the file, which is the user's."""
LONGEST_TOTAL_CPU_S, LONGEST_WALL_S = 30.0, 180.0
"""After so much work, or so long a silence, the process is ended: what waits for ever works on nothing."""
MOST_MEMORY_MB = 500.0
PROGRAMS = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "subprocess.Popen", "pty.spawn", "socket.connect")
"""Audit events of code that a file has made run."""
FOLDERS = (ROOT / "tests", *(ROOT / "tests" / name for name in ("backend", "blender", "contract")), ROOT)
_IN_MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""A folder in which files are written and read faster than on a disk; None for the usual one."""
ORDINARY = {"read", "sentences"}
"""Outcomes that are no findings."""


@dataclasses.dataclass
class Report:
    """Counts, and a line for each finding."""

    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    findings: list[str] = dataclasses.field(default_factory=list)
    causes: set[tuple[str, ...]] = dataclasses.field(default_factory=set)
    """Of findings, each of which is counted and kept once."""

    def find(self, outcome: str, what: str) -> None:
        """Count a finding, and print it."""
        self.counts[outcome] += 1
        self.findings.append(f"{outcome}: {what}")
        print(self.findings[-1], flush=True)

    def figures(self) -> dict[str, int]:
        """As benchmarks/faults.py records them."""
        names = ("inputs", "tracebacks", "garbage", "hangs", "over_500mb")
        return {**{f"fuzz_{name}": self.counts[name] for name in names}, "executions": self.counts["executions"]}


def run(
    seed: int, inputs: int, *, minutes: float | None = None, only: Sequence[str] = ("",), processes: int = 1
) -> Report:
    """Try `inputs` damaged inputs, or as many as fit into `minutes`; a process that hangs or dies is replaced.

    Kinds of inputs, those whose names contain one of `only`, are shared out among the processes.
    """
    report, end = Report(), None if minutes is None else time.monotonic() + 60 * minutes

    def work(place: int) -> None:
        number, last = 0, 10**9 if end is not None else -(-inputs // processes)
        while number < last and (end is None or time.monotonic() < end):
            options = {"seed": seed, "only": list(only), "place": place, "processes": processes, "last": last}
            options |= {"first": number, "found": list(report.causes)}
            number = _run_child(report, options, end)

    with concurrent.futures.ThreadPoolExecutor(processes) as pool:
        list(pool.map(work, range(processes)))
    return report


def _run_child(report: Report, options: dict[str, Any], end: float | None) -> int:
    """Run one process from input `first` on; returns the number of the input to go on with."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*FOLDERS, ROOT / "backend")))}
    with tempfile.TemporaryDirectory(prefix="primdiffusion_fuzz_", dir=_IN_MEMORY) as folder:
        line = [sys.executable, "-m", "fuzz.run", json.dumps({**options, "folder": folder})]
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as child:
            try:
                ended, now, reading = _listen(report, child, options["first"], end)
            finally:
                child.kill()
        if ended == 0:
            return options["last"]
        if ended == "over":
            return now
        if reading is None:
            raise RuntimeError(f"input {now}: the process ended ({ended}) before a damaged file was read")
        report.counts["inputs"] += 1
        if (cause := (reading["target"], f"ended ({ended})")) not in report.causes:
            report.causes.add(cause)
            path = Path(reading["path"])
            case = keep(CASES / folder_of(cause[0]), path.read_bytes(), path.suffix)
            outcome = "hangs" if ended is None else "tracebacks"
            report.find(outcome, f"{cause[0]}: the process {cause[1]} [{case.relative_to(CASES)}]")
    return now + 1


def _listen(
    report: Report, child: subprocess.Popen[bytes], now: int, end: float | None
) -> tuple[int | str | None, int, dict[str, Any] | None]:
    """Read messages until the process ends, has to be ended (None) or the time is "over".

    Also the number of the input to go on with, and the message before that input was read, None before the first one.
    """
    assert child.stdout is not None
    os.set_blocking(child.stdout.fileno(), False)
    heard, worked, rest = time.monotonic(), 0.0, b""
    reading = None  # while it loads torch and bpy, or what is not damaged
    while True:
        ended = child.poll()
        text = child.stdout.read() or b""
        *lines, rest = (rest + text).split(b"\n")
        for message in map(json.loads, lines):
            heard, worked = time.monotonic(), _cpu_s(child.pid)
            now = message["number"]
            if "path" in message:
                reading = message
            elif "outcome" not in message:
                reading = None
            else:
                now += 1
                report.counts["inputs"] += 1
                _note(report, message)
        if ended is not None:
            return ended, now, reading
        if end is not None and time.monotonic() > end:
            return "over", now, reading
        if time.monotonic() - heard > LONGEST_WALL_S * (1 + (reading is None)):
            return None, now, reading
        if reading is not None and _cpu_s(child.pid) - worked > LONGEST_TOTAL_CPU_S:
            return None, now, reading
        time.sleep(0.05)


def _note(report: Report, message: dict[str, Any]) -> None:
    for outcome in message["outcome"]:
        if outcome in ORDINARY:
            report.counts[outcome] += 1
        elif message["is_new"]:
            report.causes.add(tuple(message["cause"]))
            report.find(outcome, message["what"])


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


class Tried:
    """A kind of input that is being tried: a valid one, and the time that its inputs have taken."""

    def __init__(self, target: Any, path: Path) -> None:
        self.target, self.path, self.valid, self.seconds = target, path, path.read_bytes(), 0.0

    def outcome(self, content: bytes) -> tuple[list[str], str]:
        """What comes of an input, as `_outcome` says."""
        self.path.write_bytes(content)
        return _outcome(self.target, self.path)


def _serve(
    seed: int, only: Sequence[str], place: int, processes: int, first: int, last: int, folder: str,
    found: Sequence[Sequence[str]],
) -> None:  # fmt: skip
    from fuzz.targets import TARGETS

    events: list[str] = []
    sys.addaudithook(lambda event, _: events.append(event) if event in PROGRAMS else None)
    targets = [target for target in TARGETS if any(part in target.name for part in only)][place::processes]
    os.chdir(folder)
    tried: dict[str, Tried] = {}
    causes = set(map(tuple, found))
    for number in range(first, last if targets else first):
        target = min(targets, key=lambda one: tried[one.name].seconds if one.name in tried else -1.0)
        if target.name not in tried:
            _say(number=number, loads=True)
            made = Path(folder, str(number))
            made.mkdir()
            tried[target.name] = Tried(target, target.make(made))
            target.read(tried[target.name].path)  # what is not damaged is read
        one = tried[target.name]
        content = damaged(target, one.valid, seed, number)
        _say(number=number, target=target.name, path=str(one.path))
        began = time.process_time()
        events.clear()
        outcome, about = one.outcome(content)
        if set(outcome) & {"hangs", "over_500mb"}:  # once more alone: another program may have slowed it down
            outcome, about = one.outcome(content)
        if events or Path("CANARY").exists():
            outcome.append("executions")
            about += f" ({events})"
        cause = _cause(one, outcome, about)
        is_new = not set(outcome) <= ORDINARY and cause not in causes
        if is_new:
            causes.add(cause)
            if set(outcome) <= {"tracebacks", "garbage"}:
                content = shrunk(content, lambda less: _cause(one, *one.outcome(less)) == cause)  # noqa: B023
            case = keep(CASES / folder_of(target.name), content, one.path.suffix)
            about = f"{about} [{case.relative_to(CASES)}]"
        one.seconds += time.process_time() - began
        what = f"{target.name}, seed {seed}, input {number}: {about}"
        _say(number=number, outcome=outcome, what=what, is_new=is_new, cause=cause)


def _cause(one: Tried, outcome: list[str], about: str) -> tuple[str, ...]:
    """What findings with one cause have in common: where an error arose, or what is wrong. Of an error within a request
    the server tells the text alone.
    """
    if set(outcome) & {"hangs", "over_500mb"}:
        return one.target.name, outcome[-1]
    where = None if "defect in the backend" in about else re.search(r"\(\w+\.py:\d+\)", about)
    return one.target.name, *outcome, where[0] if where else re.sub(r"'[^']*'|/\S+|\d+", "", about)[:150]


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
    resource.setrlimit(resource.RLIMIT_DATA, (8 * 2**30, 8 * 2**30))
    import bpy  # noqa: F401  before the rest, which it would otherwise load anew

    _serve(**json.loads(sys.argv[1]))
