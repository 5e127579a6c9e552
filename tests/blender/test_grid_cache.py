"""Memory of volumes that are gone."""

from __future__ import annotations

import bpy
import psutil
import synthetic

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.grid_cache import free_unused_grids


def _resident_mb() -> float:
    return psutil.Process().memory_info().rss / 1e6


def test_grids_of_deleted_volumes_are_given_back_and_shown_ones_stay(saved_scene, tmp_path):
    human = synthetic.write(tmp_path / "human.npz", 64)
    kept = build_human(saved_scene, human, "Kept")
    saved_scene.view_layer.update()
    free_unused_grids()  # of earlier tests: what the process keeps of them would do for new ones
    before = _resident_mb()
    gone = build_human(saved_scene, synthetic.write(tmp_path / "other.npz", 64, seed=3), "Gone")
    saved_scene.view_layer.update()
    grown = _resident_mb()
    for thing in list(gone.all_objects):
        bpy.data.objects.remove(thing)
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    free_unused_grids()
    assert grown - before > 30, "a grid takes about 0.9 MB"
    assert _resident_mb() - before < 0.35 * (grown - before)
    assert all(thing.data.grids.load() for thing in kept.all_objects if thing.type == "VOLUME")


def test_the_users_preferences_are_as_before(empty_scene):
    system = bpy.context.preferences.system
    system.memory_cache_limit = 1234
    bpy.context.preferences.is_dirty = False
    free_unused_grids()
    assert (system.memory_cache_limit, bpy.context.preferences.is_dirty) == (1234, False)
    system.memory_cache_limit = 4096
