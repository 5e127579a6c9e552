"""Memory of volumes that are gone."""

from __future__ import annotations

import bpy
import psutil
import pytest
import synthetic

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import parts_of
from blender_primdiffusion.scene.volumes import free_unused_grids

pytestmark = pytest.mark.usefixtures("volumes_shown")


def _resident_mb() -> float:
    return psutil.Process().memory_info().rss / 1e6


def test_grids_of_deleted_volumes_are_given_back_and_shown_ones_stay(saved_scene, tmp_path):
    human = synthetic.write(tmp_path / "human", 64)
    kept = build_human(saved_scene, human, "Kept")
    saved_scene.view_layer.update()
    free_unused_grids()  # of earlier tests: what the process keeps of them would do for new ones
    before = _resident_mb()
    gone = build_human(saved_scene, synthetic.write(tmp_path / "other", 64, seed=3), "Gone")
    saved_scene.view_layer.update()
    grown = _resident_mb()
    for obj in list(parts_of(gone)):
        bpy.data.objects.remove(obj)
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    free_unused_grids()
    assert grown - before > 30, "a grid takes about 0.9 MB"
    assert _resident_mb() - before < 0.35 * (grown - before)
    assert all(obj.data.grids.load() for obj in parts_of(kept) if obj.type == "VOLUME")


def test_grids_of_people_who_are_shown_are_given_back_and_read_again(saved_scene, tmp_path):
    person = build_human(saved_scene, synthetic.write(tmp_path / "human", 64), "Shown")
    free_unused_grids()
    before = _resident_mb()
    saved_scene.view_layer.update()
    read = _resident_mb() - before
    boxes = _boxes(person)
    free_unused_grids()
    assert read > 30
    assert _resident_mb() - before < 0.35 * read
    person.pose.bones[0].location.x = 1.0
    saved_scene.view_layer.update()
    assert _resident_mb() - before < 0.35 * read, "posing reads no voxels"
    assert _boxes(person) == boxes
    for obj in parts_of(person):
        obj.update_tag()
        if obj.type == "VOLUME":
            obj.data.update_tag()
    saved_scene.view_layer.update()
    assert _boxes(person) == boxes


def _boxes(person: bpy.types.Object) -> dict[str, list[tuple[float, ...]]]:
    graph = bpy.context.evaluated_depsgraph_get()
    volumes = [obj for obj in parts_of(person) if obj.type == "VOLUME"]
    return {obj.name: [tuple(corner) for corner in obj.evaluated_get(graph).bound_box] for obj in volumes}


def test_the_users_preferences_are_as_before(empty_scene):
    system = bpy.context.preferences.system
    system.memory_cache_limit = 1234
    bpy.context.preferences.is_dirty = False
    free_unused_grids()
    assert (system.memory_cache_limit, bpy.context.preferences.is_dirty) == (1234, False)
    system.memory_cache_limit = 4096
