"""What hostile files do, and whether a seed is the same human everywhere.

    export PRIMDIFFUSION_ASSETS=DIR
    python benchmarks/faults.py --json docs/results/faults.json --window window_out/figures.json
    python benchmarks/faults.py --json docs/results/faults.json --parts blends   # the file's other figures are kept

Each part is written as soon as it is measured, with `PART_recorded`: version, commit and date. The parts are

- seed: one seed is generated on 1, 2 and 4 threads, alone and in a batch of 8: the largest difference of any number of
  the human, relative to the range of its kind; threads: of how many numbers of threads (1, 2, 3) the files of a
  generated human and a variant have the same bytes (`tests/backend/thread_bytes.py`)
- blends: a stranger's names and paths in a .blend: how many properties were tried, and how many files they changed
  outside of the folder beside it (`tests/blender/test_hostile_blends.py`)
- attacks: a stranger's lists of packages, links, texts, terminal escapes and requests, which are the inputs of the
  tests in ATTACKS: how many there are, and how many did no harm
- rigs: motions and scans of the default body as a Mixamo, Ready Player Me, Rokoko, VRoid and SOMA rig: how many are
  read and stand, and the largest error of a scan's size as a fraction (`benchmarks/real_rigs.py`)
- window: rounds of undo and redo among timers in a real window, and crashes, from the figures of
  `scripts/window/look.py --scenes undo_and_timers`; left out without --window
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import record
import torch
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.human import Human, generate_batch

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests"
SEED = 7
THREADS = (1, 2, 4)
BATCHES = (1, 8)
ATTACKS = (
    "tests/contract/test_setup_environment.py::test_only_whole_lines_of_a_requirement_or_an_index_are_read",
    "tests/contract/test_setup_environment.py::test_pip_gets_no_line_that_was_not_read",
    "tests/backend/capture/test_farm.py::test_a_subject_that_would_be_an_option_or_a_path_is_handed_to_no_renderer",
    "tests/backend/capture/test_render.py::test_no_worker_writes_through_a_link_in_the_folder_of_a_human",
    "tests/backend/files/test_regular_files.py",
    "tests/backend/files/test_whole_files.py::test_no_file_is_written_through_a_link_out_of_the_folder",
    "tests/backend/released/test_inventory.py::"
    "test_names_of_a_strangers_tensors_make_no_long_sentence_without_the_file",
    "tests/backend/runtime/test_failures.py::test_no_terminal_escape_of_a_file_is_in_a_sentence",
    "tests/backend/runtime/test_failures.py::test_the_command_line_prints_no_escape",
    "tests/backend/runtime/test_worker_process.py::test_a_link_in_place_of_the_lock_is_named_and_its_target_stays",
    "tests/backend/training/test_run_folder.py::test_nothing_is_written_through_a_link_in_a_strangers_run_folder",
    "tests/blender/scene/test_blend_values.py::test_a_record_is_parsed_once_however_often_panels_draw",
    "tests/blender/ui/test_generate_settings.py::test_a_checkpoint_that_is_damaged_or_claims_much_is_read_once",
    "tests/blender/ui/test_captures_panel.py::test_paths_that_begin_with_a_hyphen_are_no_options",
)
"""Tests whose inputs are attacks."""
Figure = float | int | bool | str | None


@dataclasses.dataclass(frozen=True)
class Part:
    """Figures that are measured together."""

    figures: tuple[str, ...]
    measure: Callable[[argparse.Namespace], dict[str, Figure]]


def main() -> None:
    parser = record.command_line(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="measure only these anew; all by default")
    parser.add_argument("--steps", type=int, default=30, help="of the sampler")
    parser.add_argument("--window", type=Path, help="figures.json of scripts/window/look.py")
    arguments = parser.parse_args()
    if "window" in (arguments.parts or ()) and arguments.window is None:
        parser.error("the part window takes its figures from a file: name it with --window")
    figures = kept(arguments.json)
    for name in arguments.parts or (name for name in PARTS if name != "window" or arguments.window):
        print(f"{name} ...", flush=True)
        found = PARTS[name].measure(arguments)
        figures |= {key: found[key] for key in PARTS[name].figures} | {recorded(name): stamp()}
        figures = {key: figures[key] for key in names() if key in figures}
        if arguments.json is not None:
            record.write_record(arguments.json, figures)
    for key, value in figures.items():
        print(key, value)


def names() -> list[str]:
    """All names in the file, in their order."""
    return [key for name, part in PARTS.items() for key in (*part.figures, recorded(name))]


def recorded(part: str) -> str:
    """The name under which the file says when a part was measured."""
    return f"{part}_recorded"


def stamp() -> str:
    """Version, commit and date of a measurement."""
    about = record.surroundings()
    return f"{about.get('version_primdiffusion', 'unknown')} {about['commit']} {about['date']}"


def kept(path: Path | None) -> dict[str, Figure]:
    """The figures of an earlier run that a part still measures; none without a file."""
    if path is None or not path.is_file():
        return {}
    before = json.loads(path.read_text(encoding="utf-8"))
    return {name: before[name] for name in names() if name in before}


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


def tried_and_held(*words: str) -> tuple[int, int]:
    """Tests that ran, and those that passed. Ends with a sentence where a test is gone."""
    said = run("-m", "pytest", "-q", "-p", "no:cacheprovider", *words, is_shown=False).splitlines()[-1]
    counts = {outcome: int(number) for number, outcome in re.findall(r"(\d+) (passed|failed|errors?)", said)}
    return sum(counts.values()), counts.get("passed", 0)


def attacks() -> dict[str, Figure]:
    """The attacks that were tried, and those that did no harm."""
    return dict(zip(PARTS["attacks"].figures, tried_and_held(*ATTACKS), strict=True))


def blends() -> dict[str, Figure]:
    """Properties of a stranger's .blend that were tried with each value, and those by which a file was written."""
    words = ("tests/blender/test_hostile_blends.py", "-m", "slow", "-k", "no_value_of_a_property")
    tried, held = tried_and_held(*words)
    return dict(zip(PARTS["blends"].figures, (tried, tried - held), strict=True))


def window(path: Path) -> dict[str, Figure]:
    """The figures of a real window. Ends with a sentence for a file without them."""
    found = json.loads(path.read_text(encoding="utf-8"))
    if missing := [name for name in PARTS["window"].figures if name not in found]:
        raise SystemExit(f"{path} has no {missing[0]}: play `scripts/window/look.py --scenes undo_and_timers`")
    return found


def tool(*words: str, is_shown: bool = True) -> dict[str, Figure]:
    """The figures in the last line of JSON that a program of the tests prints."""
    lines = [line for line in run(*words, is_shown=is_shown).splitlines() if line.startswith("{")]
    if not lines:
        raise SystemExit(f"{' '.join(words)} has printed no figures")
    return json.loads(lines[-1])


def run(*words: str, is_shown: bool = True) -> str:
    """The output of a program of the tests, which exits with 1 if it has found faults: they are figures, too."""
    folders = (ROOT, ROOT / "backend", TESTS, TESTS / "backend", TESTS / "contract", TESTS / "blender")
    path = os.pathsep.join([*map(str, folders), os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryDirectory(prefix="primdiffusion_faults_") as settings:
        done = subprocess.run(
            [sys.executable, *words],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": path, "BLENDER_USER_RESOURCES": settings},
            stdout=subprocess.PIPE,
            text=True,
            check=False,
            encoding="utf-8",
        )
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(words)} ended with exit code {done.returncode}: {done.stdout[-500:]}")
    if is_shown:
        print(done.stdout, end="", flush=True)
    return done.stdout


PARTS: dict[str, Part] = {
    "seed": Part(("threads_person_error_max",), lambda given: {"threads_person_error_max": person_error(given.steps)}),
    "threads": Part(
        ("same_bytes_threads",), lambda given: tool("tests/backend/thread_bytes.py", "--steps", str(given.steps))
    ),
    "blends": Part(("blend_properties_tried", "files_written_outside"), lambda _: blends()),
    "attacks": Part(("attack_cases", "attack_cases_held"), lambda _: attacks()),
    "rigs": Part(
        ("real_rigs", "real_rigs_read", "real_rigs_upright", "capture_scale_error_max"),
        lambda _: tool("benchmarks/real_rigs.py", is_shown=False),
    ),
    "window": Part(("window_rounds", "window_crashes"), lambda given: window(given.window)),
}

if __name__ == "__main__":
    main()
