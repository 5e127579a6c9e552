"""How long the default model takes to load and to generate on two processor threads, and the memory it needs.

`benchmarks/diffusion.py` runs this in a process of its own, so that the peak of memory is that of generating people.
"""

from __future__ import annotations

import os
import time

THREADS = 2
os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = str(THREADS)
BEGAN = time.perf_counter()

from primdiffusion.runtime.machine import share_processors  # noqa: E402 - the clock runs while it is imported

share_processors()

import argparse  # noqa: E402
import statistics  # noqa: E402
from itertools import pairwise  # noqa: E402
from pathlib import Path  # noqa: E402

import torch  # noqa: E402
from primdiffusion.diffusion.checkpoint import load_checkpoint  # noqa: E402
from primdiffusion.diffusion.model import DiffusionModel  # noqa: E402
from primdiffusion.human import generate, generate_batch  # noqa: E402
from record import report  # noqa: E402

TOGETHER = 8


def timed(model: DiffusionModel, seed: int) -> tuple[float, float, list[float]]:
    """Seconds of a person of default steps, of the processor too, and of each step but the first."""
    stamps = []
    began, used = time.perf_counter(), time.process_time()
    generate(model, seed, on_step=lambda step: stamps.append(time.perf_counter()))
    return (
        time.perf_counter() - began,
        time.process_time() - used,
        [after - before for before, after in pairwise(stamps)],
    )


def main() -> None:
    imported = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, help="without it the package's default")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(THREADS)
    began = time.perf_counter()
    model = load_checkpoint(arguments.checkpoint)
    loaded = time.perf_counter()
    first, _, _ = timed(model, 0)
    runs = [timed(model, seed) for seed in range(1, arguments.repeats + 1)]
    peak = int(Path("/proc/self/status").read_text(encoding="utf-8").partition("VmHWM:")[2].split()[0]) * 1024 / 1e9
    start = time.perf_counter()
    generate_batch(model, range(TOGETHER))
    together = (time.perf_counter() - start) / TOGETHER
    figures = {
        "threads": torch.get_num_threads(),
        "import_seconds": imported - BEGAN,
        "load_seconds": loaded - began,
        "step_seconds_cpu": statistics.median(step for _, _, steps in runs for step in steps),
        "generate_seconds_cpu": statistics.median(seconds for seconds, _, _ in runs),
        "generate_first_seconds_cpu": first,
        "generate_processor_seconds": statistics.median(processor for _, processor, _ in runs),
        "generate_seconds_a_person_of_8": together,
        "peak_gb": peak,
    }
    report({name: round(value, 4) for name, value in figures.items()}, arguments.json)


if __name__ == "__main__":
    main()
