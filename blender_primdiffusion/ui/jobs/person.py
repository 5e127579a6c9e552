"""A person whom the child has made, put into the scene: what generating and reconstructing have in common."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import bpy

from ...scene.build import build_human, build_written, stand_beside_others
from ...scene.edit import Replaced, replace_by_written, replace_person
from ...scene.grid_cache import free_unused_grids
from ...scene.overlap import overlap_warning_in
from ...worker.sentence import sentence
from .building import building


def build_person(
    context: bpy.types.Context, result: dict[str, Any], made: str, name: str = "Human"
) -> tuple[bpy.types.Collection, str]:
    """Build the person of the child's `result`; the collection and the news for the panel ("Generated in 1.2 s, ...").

    Raises as `build_human` does, and then leaves nothing.
    """
    keep = [Path(result["person"])] if "person" in result else []  # for the exact marcher, later
    human = Path(result["human"])
    written, began = building.take(human), time.monotonic()
    if written is not None:
        began = written.began
        collection = build_written(context, written, name, keep)
    else:
        collection = build_human(context, human, name, keep)
    stand_beside_others(context, collection)
    warnings = list(result.get("warnings", ()))
    if overlap := overlap_warning_in(context.scene, collection):
        warnings.append(overlap)
    notice = f"{made} in {result['seconds']:.1f} s, built in {time.monotonic() - began:.1f} s"
    return collection, " ".join([sentence(notice), *map(sentence, warnings)])


def show_in_place(context: bpy.types.Context, person: bpy.types.Collection, result: dict[str, Any]) -> Replaced:
    """Show the person of the child's `result` where `person` is. Raises as `replace_person` does."""
    human, file = Path(result["human"]), Path(result["person"])
    written = building.take(human)
    if written is not None:
        return replace_by_written(person, written, file)
    done = replace_person(person, human, file)
    context.view_layer.update()  # what is evaluated holds the grids of before
    free_unused_grids()
    return done
