"""Writes docs/results.md: one table for each file in docs/results, with every number as measured by a benchmark."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
SOURCES = {
    "demo": ("The demo", "benchmarks/demo.py --json docs/results/demo.json"),
    "people": ("Payloads against their meshes", "benchmarks/people.py --assets DIR --json docs/results/people.json"),
    "march": ("The marcher", "benchmarks/march.py --json docs/results/march.json --table docs/results/march_table.md"),
    "march_cuda": ("The marcher on a CUDA device", "benchmarks/march_cuda.py --json docs/results/march_cuda.json"),
    "extension": ("The extension on Blender 5.0", "benchmarks/extension.py --json docs/results/extension.json"),
    "splats": (
        "A human as splats on Blender 5.3",
        "benchmarks/splats.py --pictures DIR --json docs/results/splats.json",
    ),
    "first_sight": (
        "From the backend's answer to a human in Blender",
        "benchmarks/first_sight.py --json docs/results/first_sight.json --window FIGURES ... viewport.json",
    ),
    "engine": ("The engine in Blender", "benchmarks/engine.py --json docs/results/engine.json"),
    "denoisers": ("Denoisers on held-out people", "benchmarks/denoisers.py --json docs/results/denoisers.json"),
    "equal_minutes": (
        "Settings of the local network's training on equal minutes",
        "benchmarks/equal_minutes.py --data PEOPLE --minutes 18 --json docs/results/equal_minutes.json",
    ),
    "faithful": (
        "Faithfulness to the released networks and the paper's metrics",
        "benchmarks/faithful.py --json docs/results/faithful.json",
    ),
    "captures": ("Captures", "benchmarks/captures.py --assets DIR --json docs/results/captures.json"),
    "encoder": (
        "The encoder",
        "benchmarks/encoder.py --train DIR --heldout DIR --models DIR --json docs/results/encoder.json "
        "--table docs/results/encoder_table.md",
    ),
    "refine": ("Refining on captures", "benchmarks/refine.py --assets DIR --json docs/results/refine.json"),
    "encoder_ablations": (
        "The encoder's ablations, 240 steps each, with boxes of one thickness",
        "benchmarks/encoder.py --train DIR --heldout DIR --models DIR --json docs/results/encoder_ablations.json "
        "--table docs/results/encoder_ablations_table.md",
    ),
    "diffusion": (
        "Generated people",
        "benchmarks/diffusion.py --people DIR --reference DIR --voxel FILE --json docs/results/diffusion.json "
        "--table docs/results/diffusion_table.md",
    ),
    "tables": (
        "The paper's Table 2: other representations, trained for equal time",
        "benchmarks/tables.py --models DIR --assets DIR --json docs/results/tables.json "
        "--table docs/results/tables_table.md",
    ),
    "from_pictures": (
        "From one view, by the person prior",
        "benchmarks/from_pictures.py --assets DIR --json docs/results/from_pictures.json",
    ),
    "plain_pictures": (
        "From one plain picture, whose pose and camera are refined",
        "benchmarks/plain_pictures.py --assets DIR --json docs/results/plain_pictures.json",
    ),
    "encoder_paper_form": (
        "The paper's Table 3 in the paper's own form",
        "benchmarks/encoder_paper_form.py --train DIR --novel DIR --out DIR "
        "--json docs/results/encoder_paper_form.json",
    ),
    "attribute_hits": (
        "Attributes that were asked for",
        "benchmarks/attribute_hits.py --people DIR --json docs/results/attribute_hits.json",
    ),
    "face_boxes": (
        "256 more boxes on the face",
        "benchmarks/face_boxes.py --assets DIR --json docs/results/face_boxes.json",
    ),
    "faults": ("Faults: hostile files, kills, full disks", "benchmarks/faults.py --json docs/results/faults.json"),
    "everywhere": (
        "Other systems, programs and devices",
        "benchmarks/everywhere.py --json docs/results/everywhere.json",
    ),
    "layout": ("The grid on the default body", "scripts/bake_layout"),
}  # fmt: skip
ABOUT = ("device", "cores", "memory_gb", "python", "commit", "date")
"""Facts about the measurement, printed above the table; package versions stay in the JSON file."""


def section(name: str) -> str:
    """The table of docs/results/NAME.json, null as "not measured", followed by the benchmark's own table if any."""
    title, command = SOURCES[name]
    record = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    about = ", ".join(f"{key} {record[key]}" for key in ABOUT if key in record)
    lines = [f"## {title}", f"`{command}`", "", about, "", "| figure | value |", "|---|---|"]
    for key, value in record.items():
        if key not in ABOUT and not key.startswith("version_"):
            lines.append(f"| {key} | {_written(value)} |")
    table = RESULTS / f"{name}_table.md"
    if table.is_file():
        lines += ["", table.read_text(encoding="utf-8").rstrip()]
    return "\n".join(lines)


def main() -> None:
    head = "# Results\n\nMade by `benchmarks/report.py` from `docs/results`; the commands write the files.\n\n"
    present = [name for name in SOURCES if (RESULTS / f"{name}.json").is_file()]
    (ROOT / "docs" / "results.md").write_text(head + "\n\n".join(map(section, present)) + "\n", encoding="utf-8")


def _written(value: object) -> str:
    if value is None:
        return "not measured"
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(value) if isinstance(value, (dict, list)) else str(value)


if __name__ == "__main__":
    main()
