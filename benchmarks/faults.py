"""What hostile files, kills, full disks and dead children do, and whether a seed is the same human everywhere.

    python benchmarks/faults.py --json docs/results/faults.json

Runs `python -m tests.fuzz` and `python -m tests.chaos` (about an hour in all), whose figures are described there. Then
one seed is generated on 1, 2 and 4 threads, alone and in a batch of 8: the largest difference of any number of the
human, relative to the range of its kind. Two processes write the same seed: their files must have the same bytes.

Small files that claim much (`tests/fuzz/small_inputs.py`) are read one by one: `small_input_peak_mb` is the largest
peak of memory, `small_input_seconds` the longest time.

With --parts some of the four are measured anew, and the file's other figures are kept.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import record
import torch
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.human import Human, generate_batch

ROOT = Path(__file__).resolve().parents[1]
SEED = 7
THREADS = (1, 2, 4)
BATCHES = (1, 8)
PERSON = "person.human.safetensors"
PARTS = ("seed", "small", "fuzz", "chaos")
Figure = float | int | bool | str | None


def main() -> None:
    parser = record.command_line(__doc__)
    parser.add_argument("--fuzz-inputs", type=int, default=20_000)
    parser.add_argument("--chaos-minutes", type=float, default=30.0)
    parser.add_argument("--deaths", type=int, default=1000, help="of the child")
    parser.add_argument("--steps", type=int, default=30, help="of the sampler")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="measure only these anew")
    arguments = parser.parse_args()
    figures = {} if set(arguments.parts) == set(PARTS) else kept(arguments.json)
    if "seed" in arguments.parts:
        figures["threads_person_error_max"] = person_error(arguments.steps)
        figures["same_seed_bytes_equal"] = same_bytes(arguments.steps)
    if "small" in arguments.parts:
        figures |= tool("tests.fuzz", "--small")
    if "fuzz" in arguments.parts:
        began = time.monotonic()
        figures |= tool("tests.fuzz", "--forget", "--inputs", str(arguments.fuzz_inputs))
        figures |= tool("tests.fuzz", "--verdicts")
        figures["fuzz_seconds"] = round(time.monotonic() - began, 1)
    if "chaos" in arguments.parts:
        began = time.monotonic()
        figures |= chaos(arguments.chaos_minutes, arguments.deaths)
        figures["chaos_seconds"] = round(time.monotonic() - began, 1)
    record.report(figures, arguments.json)


def kept(path: Path | None) -> dict[str, Figure]:
    """The figures of an earlier run; none without a file."""
    if path is None or not path.is_file():
        return {}
    about = record.surroundings()
    return {name: value for name, value in json.loads(path.read_text(encoding="utf-8")).items() if name not in about}


def person_error(steps: int) -> float:
    """The largest difference between a human's numbers on different threads and in different batches, of their range.

    Raises ValueError for a human without any.
    """
    model, before = load_checkpoint(None, torch.device("cpu")), torch.get_num_threads()
    people = []
    try:
        for threads, batch in itertools.product(THREADS, BATCHES):
            torch.set_num_threads(threads)
            people.append(numbers(generate_batch(model, range(SEED, SEED + batch), steps)[0]))
    finally:
        torch.set_num_threads(before)
    first = people[0]
    return max(
        float((other[name] - values).abs().max() / (values.max() - values.min()))
        for other in people[1:]
        for name, values in first.items()
    )


def numbers(human: Human) -> dict[str, torch.Tensor]:
    payload = human.payload
    tensors = {
        "rgb": payload.rgb,
        "density": payload.density,
        "delta_scale": payload.delta_scale,
        "betas": human.betas,
    }
    return {name: tensor.double() for name, tensor in tensors.items() if tensor.max() > tensor.min()}


def same_bytes(steps: int) -> bool:
    """Whether two processes write the same file for a seed."""
    with tempfile.TemporaryDirectory(prefix="primdiffusion_faults_") as name:
        files = []
        for number in range(2):
            out = Path(name) / str(number)
            words = ["generate", "--seed", str(SEED), "--steps", str(steps), "--size", "32", "--out", str(out)]
            subprocess.run([sys.executable, "-m", "primdiffusion", *words], check=True, stdout=subprocess.DEVNULL)
            files.append((out / PERSON).read_bytes())
    return files[0] == files[1]


def chaos(minutes: float, deaths: int) -> dict[str, int]:
    with tempfile.TemporaryDirectory(prefix="primdiffusion_faults_") as name:
        figures = Path(name) / "figures.json"
        options = ["--minutes", str(minutes), "--deaths", str(deaths), "--json", str(figures)]
        run("tests.chaos", options)
        return json.loads(figures.read_text(encoding="utf-8"))


def tool(module: str, *options: str) -> dict[str, int]:
    """The figures in the last line of a module's output."""
    return json.loads(run(module, options).strip().splitlines()[-1])


def run(module: str, options: Sequence[str]) -> str:
    """The output of a module of the tests, which exits with 1 if it has found faults: they are figures, too."""
    path = os.pathsep.join((str(ROOT), str(ROOT / "backend"), os.environ.get("PYTHONPATH", "")))
    done = subprocess.run(
        [sys.executable, "-m", module, *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 1):
        raise SystemExit(f"{module} ended with exit code {done.returncode}: {done.stdout[-500:]}")
    print(done.stdout, end="", flush=True)
    return done.stdout


if __name__ == "__main__":
    main()
