"""The whole pipeline in one command: zip, install, generate, walk, save, render, march, contact sheet, and a table.

Each stage runs in its own process and is measured from outside. `--json FILE` also writes the figures.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import record
from PIL import Image
from primdiffusion.runtime.machine import share_processors

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
FRAMES, SHOWN = 48, 31
SEED = 57
"""A human of the included checkpoint with a clear face, even cloth and a clean collar: the fourth of seeds 0 to 63 by
how close its pictures are to those of meshes (`scripts/feature_space`)."""
PRINT_S = 5.0
"""Seconds between lines of progress."""
LINE = 100
"""Characters of such a line."""


def main() -> None:
    """Runs the stages one after another; if a stage fails, the demo ends with the last lines of its output."""
    parser = record.command_line(__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "demo_out")
    parser.add_argument("--quick", action="store_true", help="no Cycles frame, a small contact sheet")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument(
        "--assets",
        type=Path,
        default=nearby_assets(),
        help="MakeHuman asset folder; with --json, 16 people made from it are compared to their meshes",
    )
    arguments = parser.parse_args()
    share_processors()
    out, logs = arguments.out.resolve(), arguments.out.resolve() / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    blend, human = out / "human.blend", out / "person.human.safetensors"
    start = time.perf_counter()
    rows: list[Stage] = []
    figures: dict[str, float | None] = {"people_iou_mean": None, "people_psnr_mean": None}

    def stage(name: str, script: str, *options: str | Path, figures_file: bool = True) -> None:
        written = logs / f"{len(rows)}.json"
        figures_option = ["--json", written] if figures_file else []
        print(f"{name} ...", flush=True)
        rows.append(
            run_stage(name, [sys.executable, ROOT / script, *options, *figures_option], logs / f"{len(rows)}.log")
        )
        if figures_file:
            figures.update(json.loads(written.read_text(encoding="utf-8")))

    stage("build the extension", "build_addon.py", "--out", out, figures_file=False)
    archive = next(out.glob("primdiffusion-*.zip"))
    made = ("--human", human, "--skinned", logs / "skinned.npz", "--frames", str(FRAMES))
    frame = () if arguments.quick else ("--cycles", out / "cycles.png")
    stage("a person in Blender" + ("" if arguments.quick else ", in Cycles"), "benchmarks/demo_blender.py", *made,
          "--zip", archive, "--blend", blend, "--seed", str(arguments.seed), "--shown", str(SHOWN), *frame)  # fmt: skip
    count = "4" if arguments.quick else "6"
    stage("pictures by the marcher", "benchmarks/demo_pictures.py", *made,
          "--frame", str(SHOWN), "--count", count, "--out", out)  # fmt: skip
    figures["demo_seconds_after_setup"] = time.perf_counter() - start
    if arguments.json is not None and arguments.assets is not None:
        options = ["--quick"] if arguments.quick else []
        stage("people against meshes", "benchmarks/people.py", "--assets", arguments.assets, *options)

    overview(out, ["march_rest", "march_posed", "march_side", "march_depth", "march_boxes", "cycles"])
    figures["seconds_setup_excluded_total"] = time.perf_counter() - start
    figures["peak_gb"] = max(row.took.peak_gb for row in rows)
    print(f"\n{table(rows)}\n")
    print(f"from pressing the button to a person in the scene: {figures['seconds_pressed_to_standing']:.1f} s")
    print(f"the body follows linear blend skinning within {figures['lbs_error_mm_max']:.5f} mm")
    print(f"look at {out}: overview.png, contact_sheet.png, and with {archive.name} installed, human.blend")
    if arguments.json is not None:
        about = record.surroundings()  # that stage has printed its own figures
        record.write_record(arguments.json, {name: value for name, value in figures.items() if name not in about})


@dataclasses.dataclass(frozen=True)
class Stage:
    """A finished stage, its time and memory."""

    name: str
    took: record.Measurement


class StageFailed(RuntimeError):
    """A stage ended with a non-zero exit code."""


def run_stage(name: str, command: Sequence[str | Path], log: Path) -> Stage:
    """Runs `command` with its output in `log`, of which it prints the last line every PRINT_S seconds.

    Raises StageFailed with the end of that output if it fails.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as output, record.measured() as took:
        began = time.perf_counter()
        process = subprocess.Popen([str(part) for part in command], stdout=output, stderr=subprocess.STDOUT)
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(PRINT_S)
                break
            lines = log.read_text(errors="replace", encoding="utf-8").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), "")
            print(f"  {time.perf_counter() - began:3.0f} s  {last[:LINE]}", flush=True)
    if code != 0:
        tail = "\n".join(log.read_text(errors="replace", encoding="utf-8").splitlines()[-25:])
        raise StageFailed(f"{name} ended with exit code {code}; the whole output is in {log}:\n{tail}")
    return Stage(name, took)


def table(rows: Sequence[Stage]) -> str:
    """Seconds and peak memory of each stage, with the sum and the maximum in the last row."""
    width = max(len(row.name) for row in rows)
    lines = [f"{'stage':<{width}}  {'seconds':>8}  {'peak GB':>8}"]
    lines += [f"{row.name:<{width}}  {row.took.seconds:8.1f}  {row.took.peak_gb:8.2f}" for row in rows]
    total, peak = sum(row.took.seconds for row in rows), max(row.took.peak_gb for row in rows)
    return "\n".join([*lines, f"{'total':<{width}}  {total:8.1f}  {peak:8.2f}"])


def nearby_assets() -> Path | None:
    """The folder that PRIMDIFFUSION_ASSETS names, or an existing one beside the checkout; None without either."""
    beside = ROOT.parent / "shared" / "data" / "makehuman"
    folder = Path(os.environ.get("PRIMDIFFUSION_ASSETS", beside))
    return folder if folder.is_dir() else None


def overview(out: Path, names: list[str], size: int = 384) -> None:
    """Saves the existing pictures side by side as out/overview.png."""
    pictures = [Image.open(out / f"{name}.png").convert("RGB") for name in names if (out / f"{name}.png").is_file()]
    strip = Image.new("RGB", (size * len(pictures), size))
    for column, picture in enumerate(pictures):
        strip.paste(picture.resize((size, size), Image.Resampling.LANCZOS), (column * size, 0))
    strip.save(out / "overview.png", optimize=True)


if __name__ == "__main__":
    main()
