"""How quickly the extension notices a cancel, a message or a death of its child, when ticked by Blender's timer.

    python benchmarks/child.py --json FILE

Waits are in seconds from the event to the tick that shows it: a cancel while torch is loaded, between steps, and while
the child is stopped in the middle of a step; a child that is killed. The longest tick of all is also recorded, and the
longest one under a flood of messages.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import record

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from blender_primdiffusion.backend.client import BackendClient, Died  # noqa: E402
from blender_primdiffusion.backend.requests import Backend, ChildRequest  # noqa: E402

TICK_S = 0.1
"""The interval of Blender's timer in seconds."""
STEPS = 1000
"""The sampling steps of a job, more than any measurement waits for."""
BEATS = 10
FLOOD = """
import json, sys
for i in range(300_000):
    progress = {"id": 2, "stage": "sample", "step": i, "total": 300_000, "eta_s": 1.0}
    print(json.dumps({"jsonrpc": "2.0", "method": "progress", "params": progress}))
"""
TIMEOUT_S = 120.0


class Timer:
    """Ticks jobs and records the longest tick."""

    def __init__(self) -> None:
        self.longest_s = 0.0

    def until(self, job: ChildRequest, reached: Callable[[], bool]) -> float:
        """Seconds until `reached` is true; raises TimeoutError."""
        began = time.monotonic()
        while not reached():
            if time.monotonic() - began > TIMEOUT_S:
                raise TimeoutError(f"waited {TIMEOUT_S:.0f} s for a job that is {job.state}: {job.message}")
            before = time.monotonic()
            job.tick()
            self.longest_s = max(self.longest_s, time.monotonic() - before)
            if not reached():
                time.sleep(TICK_S)
        return time.monotonic() - began


def main() -> None:
    parser = record.command_line(__doc__)
    arguments = parser.parse_args()
    timer = Timer()
    with tempfile.TemporaryDirectory(prefix="primdiffusion_child_") as name:
        folder = Path(name)
        figures: dict[str, float | None] = {
            "cancel_loading_seconds": cancel_seconds(
                timer, folder, lambda job: bool(job.info) and not job.info.get("ready")
            ),
            "cancel_sampling_seconds": cancel_seconds(timer, folder, lambda job: job.step > 2),
            "cancel_stopped_seconds": cancel_seconds(timer, folder, lambda job: job.step > 2, signal.SIGSTOP),
            "death_noticed_seconds": death_seconds(timer, folder),
            "heartbeat_interval_seconds_max": heartbeat_interval_s(),
            "flood_tick_seconds_max": flood_tick_s(folder),
        }
    figures["tick_seconds_max"] = timer.longest_s
    record.report(figures, arguments.json)


def cancel_seconds(timer: Timer, folder: Path, when: Callable[[ChildRequest], bool], send: int = 0) -> float:
    """Seconds from the cancel to the end of a job.

    The cancel comes when `when` holds for the job and, if `send` is given, after this signal was sent to its child.
    """
    backend = Backend(this_python)
    job = generate(backend, folder)
    timer.until(job, lambda: backend.client is not None and backend.client.pid is not None and when(job))
    os.kill(backend.client.pid, send)
    job.cancel()
    seconds = timer.until(job, lambda: job.finished)
    backend.shutdown()
    return seconds


def death_seconds(timer: Timer, folder: Path) -> float:
    """Seconds from the death of a busy child to the failure of its job."""
    backend = Backend(this_python)
    job = generate(backend, folder)
    timer.until(job, lambda: job.step > 2)
    os.kill(backend.client.pid, signal.SIGKILL)
    seconds = timer.until(job, lambda: job.finished)
    backend.shutdown()
    return seconds


def this_python() -> BackendClient:
    """The real child, run by the Python that runs this script."""
    return BackendClient(Path(sys.executable))


def flood_tick_s(folder: Path) -> float:
    """The longest tick in seconds while a child writes messages as fast as it can."""
    package = folder / "flood" / "primdiffusion"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "serve.py").write_text(FLOOD, encoding="utf-8")
    client, longest = BackendClient(Path(sys.executable), folder / "flood"), 0.0
    client.start()
    ended = False
    while not ended:
        before = time.monotonic()
        ended = any(isinstance(event, Died) for event in client.poll())
        longest = max(longest, time.monotonic() - before)
        time.sleep(TICK_S / 10)
    return longest


def heartbeat_interval_s() -> float:
    """The longest interval between BEATS heartbeats of an idle child, in seconds."""
    pipe = subprocess.PIPE
    child = subprocess.Popen([sys.executable, "-m", "primdiffusion.serve"], stdin=pipe, stdout=pipe)
    times, ready = [], False
    assert child.stdin is not None
    assert child.stdout is not None
    for line in child.stdout:
        method = json.loads(line).get("method")
        ready |= method == "ready"
        if ready and method == "heartbeat":
            times.append(time.monotonic())
        if len(times) > BEATS:
            break
    child.stdin.close()
    child.wait()
    return max(after - before for before, after in pairwise(times))


def generate(backend: Backend, folder: Path) -> ChildRequest:
    return ChildRequest(backend, "generate", {"seed": 1, "steps": STEPS, "size": 16, "out_dir": str(folder / "out")})


if __name__ == "__main__":
    main()
