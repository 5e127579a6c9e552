"""A person whom the child has made, put into the scene: what generating and reconstructing have in common."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import bpy

from ..scene.build import build_written, next_folder, stand_beside_others
from ..scene.edit import Replaced, edit_destination, replace_person
from ..scene.grid_cache import free_unused_grids
from ..scene.overlap import overlap_warning_in
from ..scene.writing import Destination, write_now
from ..worker.sentence import sentence
from .building import building


def build_person(
    context: bpy.types.Context, result: dict[str, Any], made: str, name: str = "Human"
) -> tuple[bpy.types.Collection, str]:
    """Build the person of the child's `result`; the collection and the news for the panel ("Generated in 1.2 s, ...").

    Raises as `build_human` does, and then leaves nothing.
    """
    keep = [Path(result["person"])] if "person" in result else []  # for the exact marcher, later
    human = Path(result["human"])
    written = building.take(human) or write_now(human, Destination(next_folder(name)))
    collection = build_written(context, written, name, keep)
    stand_beside_others(context, collection)
    warnings = list(result.get("warnings", ()))
    if overlap := overlap_warning_in(context.scene, collection):
        warnings.append(overlap)
    notice = f"{made} in {result['seconds']:.1f} s, built in {time.monotonic() - written.began:.1f} s"
    return collection, " ".join([sentence(notice), *map(sentence, warnings)])


def show_in_place(context: bpy.types.Context, person: bpy.types.Collection, result: dict[str, Any]) -> Replaced:
    """Show the person of the child's `result` where `person` is. Raises as `replace_person` does."""
    human, file = Path(result["human"]), Path(result["person"])
    written = building.take(human)
    done = replace_person(person, written or write_now(human, edit_destination(person)), file)
    if written is None:  # otherwise `building` has freed them before it read the new ones
        context.view_layer.update()  # evaluated data holds the old grids
        free_unused_grids()
    return done
