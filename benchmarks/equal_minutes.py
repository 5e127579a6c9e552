"""Compares settings of the local network's training: what each reaches in the same time, from the same start.

    python benchmarks/equal_minutes.py --data PEOPLE --minutes 18 --json docs/results/equal_minutes.json

PEOPLE is a training set of `primdiffusion payloads`. Codec, closed form and latents are the default checkpoint's; the
local network starts untrained and learns on one processor core, two variants at a time. Minutes are processor time.
Figures are root mean square x0 errors on held-out people in latent units, at low, medium and high noise, and the steps
that were taken:

    default        the default preset: bfloat16, Muon, levels log_normal, an average of weights
    adamw          AdamW for all layers
    float32        without bfloat16 in the network
    float32_adamw  both, as on devices that are slow in bfloat16
    uniform        levels uniform in t, as in the paper
    wide           widths of 256, 320 and 384 in place of 192, 256 and 320
"""

from __future__ import annotations

import concurrent.futures
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from primdiffusion.diffusion.checkpoint import default_checkpoint, read_card
from primdiffusion.training.cells import PREPARED
from record import command_line, report

LEVELS = ("50", "100", "300", "500")
WIDE = ("--model.widths", "256", "320", "384")
VARIANTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "adamw": ("--local.optimiser", "adamw"),
    "float32": ("--local.no-bfloat16",),
    "float32_adamw": ("--local.no-bfloat16", "--local.optimiser", "adamw"),
    "uniform": ("--local.levels", "uniform"),
    "wide": WIDE,
}
UNMEASURED = ("--local.evaluate-every", "1000000", "--pictures-every", "1000000")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="training set of `primdiffusion payloads`")
    parser.add_argument("--minutes", type=float, default=4.0, help="processor time of each variant")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        train(given.data, folder / "start", 0.0, "--start-from", str(default_checkpoint()))

        def trained(name: str) -> dict[str, float]:
            run = folder / name
            run.mkdir()
            os.link(folder / "start" / PREPARED, run / PREPARED)
            train(given.data, run, given.minutes, *VARIANTS[name])
            card = read_card(run / "model.safetensors")
            errors = card["held_out_rms_x0_error"]["denoiser"]
            return {f"rms_{level}_{name}": errors[level] for level in LEVELS} | {f"steps_{name}": steps(run)}

        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            figures = [dict(each) for each in pool.map(trained, VARIANTS)]
        untrained = read_card(folder / "start" / "model.safetensors")["held_out_rms_x0_error"]["mixture"]
    closed = {f"rms_{level}_untrained": untrained[level] for level in LEVELS}
    report({"minutes": given.minutes} | closed | {k: v for each in figures for k, v in each.items()}, given.json)


def train(data: Path, run: Path, minutes: float, *options: str) -> None:
    """Train on one core for so much processor time; 0 prepares and stops. Raises CalledProcessError."""
    limit = ("--minutes", "0") if not minutes else ()
    command = [sys.executable, "-m", "primdiffusion", "train", "--data", str(data), "--run", str(run),
               "--threads", "1", *limit, *UNMEASURED, *options]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
        while minutes and child.poll() is None and processor_seconds(child.pid) < 60 * minutes:
            time.sleep(1)
        if minutes:
            child.send_signal(signal.SIGTERM)  # `train` ends the step, saves and measures
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command)


def processor_seconds(process: int) -> float:
    """Processor time of a process so far."""
    times = psutil.Process(process).cpu_times()
    return times.user + times.system


def steps(run: Path) -> int:
    """Steps of the local network."""
    return int(read_card(run / "model.safetensors")["steps"]["local"])


if __name__ == "__main__":
    main()
