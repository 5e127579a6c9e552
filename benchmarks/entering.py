"""Measures how long Blender's window is blocked while a person of 1024 volumes is added to the scene.

`python benchmarks/entering.py --json entering.json`. Figures are milliseconds of wall time that the main thread spends
without a pause. Scripts and background mode do it at once: at_once_build_ms, then at_once_evaluate_ms until Blender
can draw. In a window, a timer writes the volumes in slices (write_ms) and reads their grids in slices (read_ms, each
slice longest_read_ms at most); only enter_build_ms and enter_undo_ms, which includes evaluating the scene, block the
window. second_* are the same for a second person in the scene. edit_* are for replacing a person with all volumes
changed; at_once_edit_ms and at_once_edit_evaluate_ms are the same without slices. Drawing is not included;
`scripts/window/look.py --scenes stalls` includes it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
from march_people import checkered_human
from primdiffusion.human_file import export_for_blender
from record import command_line, report

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from blender_primdiffusion.jobs.follow import SLICE_S
from blender_primdiffusion.scene.build import build_human, build_written, next_folder
from blender_primdiffusion.scene.edit import edit_destination, replace_person
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.human_npz import Destination, WrittenHuman, write_now
from blender_primdiffusion.scene.volumes import free_unused_grids, read_grids


def milliseconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return 1000 * (time.perf_counter() - began)


def new_file(folder: Path, name: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / name))
    bpy.ops.ed.undo_push(message="before")


def prepare(human: Path, destination: Destination) -> tuple[WrittenHuman, dict[str, float]]:
    """The sliced part of adding a person, as a window does it."""
    began = time.perf_counter()
    written = write_now(human, destination)
    figures = {"write_ms": 1000 * (time.perf_counter() - began)}
    parts, read = [], 0
    while read < len(written.unread):
        began = time.perf_counter()
        read += read_grids(written.unread[read:], SLICE_S)
        parts.append(1000 * (time.perf_counter() - began))
    return written, figures | {"read_ms": sum(parts), "longest_read_ms": max(parts)}


def enter(human: Path) -> dict[str, float]:
    """Add a person as a window does, one part after another; returns the milliseconds of each."""
    written, figures = prepare(human, Destination(next_folder("Human")))
    figures["enter_build_ms"] = milliseconds(lambda: build_written(bpy.context, written))
    figures["enter_undo_ms"] = milliseconds(lambda: bpy.ops.ed.undo_push(message="Generate Human"))
    return figures


def edit(person: bpy.types.Collection, human: Path, file: Path) -> dict[str, float]:
    """Replace `person` with `human` in the same way; the old grids are freed first, as in a window."""
    freed = milliseconds(free_unused_grids)
    written, figures = prepare(human, edit_destination(person))
    figures["free_ms"] = freed
    figures["enter_swap_ms"] = milliseconds(lambda: replace_person(person, written, file))
    figures["enter_evaluate_ms"] = milliseconds(bpy.context.view_layer.update)
    figures["enter_undo_ms"] = milliseconds(lambda: bpy.ops.ed.undo_push(message="Vary Human"))
    return figures


def main() -> None:
    parser = command_line(__doc__)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="primdiffusion_entering_") as folder:
        figures = measured(Path(folder))
    report(figures, arguments.json)


def measured(folder: Path) -> dict[str, float]:
    """Figures of a person added at once, one added in parts, a second one beside them, and edits of both."""
    people = [folder / f"human_{seed}.npz" for seed in range(5)]
    for seed, path in enumerate(people):
        export_for_blender(path, checkered_human(seed))
    new_file(folder, "at_once.blend")
    figures = {"at_once_build_ms": milliseconds(lambda: build_human(bpy.context, people[0]))}
    figures["at_once_evaluate_ms"] = milliseconds(bpy.context.view_layer.update)
    new_file(folder, "in_parts.blend")
    figures |= enter(people[1])
    figures |= {f"second_{name}": value for name, value in enter(people[2]).items()}
    first, second = humans(bpy.context.scene)
    file = folder / "person.human.safetensors"
    file.write_bytes(b"a person")
    figures["at_once_edit_ms"] = milliseconds(
        lambda: replace_person(first, write_now(people[3], edit_destination(first)), file)
    )
    figures["at_once_edit_evaluate_ms"] = milliseconds(bpy.context.view_layer.update)
    free_unused_grids()
    figures |= {f"edit_{name}": value for name, value in edit(second, people[4], file).items()}
    return figures


if __name__ == "__main__":
    main()
