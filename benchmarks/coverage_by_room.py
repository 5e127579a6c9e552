"""Line coverage of the default tests on Blender 5.0 by room, before rooms were reorganised (commit c177861) and now.

    make test-5.0 TEST_ARGS="--cov=backend/primdiffusion --cov=blender_primdiffusion --cov-report=json:after.json"
    python benchmarks/coverage_by_room.py before.json after.json --json docs/results/coverage_rooms.json

The first line in a checkout of each commit, with pytest-cov, and coverage.py set up to measure child processes too.
Code that numba compiles counts as missed, and so does what needs a GPU. Former files count for the room that has their
contents now.
"""

import json
import re
from collections import Counter
from pathlib import Path

import record

ROOMS = (
    (r".*/formats/", "formats"),
    (r".*/(capture/((camera|picture)_files|layout|plain_npz|rig)|motion/arrays|scene/joints)\.", "formats"),
    (r"backend/\w+/(raster/|geometry/uv_atlas|capture/(mip|multisample|rasterised?|soup|texture_pyramid)\.)", "raster"),
    (r"backend/\w+/((serve|commands)/|\w+_command|person_folder|\w+/command\.)", "commands_serve"),
    (r"backend/\w+/training/checkpoint\.", "diffusion"),
    (r"backend/\w+/training/encoder_checkpoint\.", "encoder"),
    (r"backend/\w+/(\w+)/", r"\1"),
    (r"backend/", "top"),
    (r"\w+/(backend|worker)/", "extension_backend"),
    (r"\w+/(jobs|ui)/", "extension_jobs_ui"),
    (r"\w+/engine/(gpu_|viewport)", "extension_engine_gpu"),
    (r"\w+/(\w+)/", r"extension_\1"),
    (r"", "extension_top"),
)
"""The first pattern that a path begins with names its room."""


def main() -> None:
    parser = record.command_line(__doc__)
    parser.add_argument("before", type=Path, help="coverage's JSON report of the former commit")
    parser.add_argument("after", type=Path, help="the same of this one")
    arguments = parser.parse_args()
    before, after = by_room(arguments.before), by_room(arguments.after)
    figures: dict[str, float | None] = {}
    for room in sorted(before | after, key=lambda room: (room != "all", "extension" in room, room)):
        for name, (lines, covered) in (("before", before.get(room, (0, 0))), ("after", after.get(room, (0, 0)))):
            figures[f"{room}_lines_{name}"] = lines
            figures[f"{room}_percent_{name}"] = round(100 * covered / lines, 1) if lines else None
    record.report(figures, arguments.json)


def by_room(path: Path) -> dict[str, tuple[int, int]]:
    """Room -> lines with code, and how many of them ran; "all" is the sum."""
    lines, covered = Counter(), Counter()
    for file, content in json.loads(path.read_text())["files"].items():
        room = next(match.expand(name) for pattern, name in ROOMS if (match := re.match(pattern, file)))
        for part in ("all", room):
            lines[part] += content["summary"]["num_statements"]
            covered[part] += content["summary"]["covered_lines"]
    return {room: (lines[room], covered[room]) for room in lines if lines[room]}


if __name__ == "__main__":
    main()
