"""Memory of volumes that are gone."""

import bpy
import psutil
import synthetic

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import parts_of
from blender_primdiffusion.scene.representation import show_in_viewport
from blender_primdiffusion.scene.volume_nodes import write_volumes
from blender_primdiffusion.scene.volumes import free_unused_grids


def _resident_mb() -> float:
    return psutil.Process().memory_info().rss / 1e6


def _draw(person: bpy.types.Object) -> int:
    show_in_viewport(person, True)
    bpy.context.view_layer.update()
    found = (one.object for one in bpy.context.evaluated_depsgraph_get().object_instances)
    return sum(all(grid.load() for grid in obj.data.grids) for obj in found if obj.type == "VOLUME")


def test_grids_of_deleted_humans_are_given_back(saved_scene, tmp_path):
    files = [synthetic.write(tmp_path / name, 64, seed) for seed, name in enumerate("ab")]
    people = [build_human(saved_scene, file) for file in files]
    for person in people:
        write_volumes(person)
    _draw(people[0])
    free_unused_grids()  # of earlier tests: what the process keeps of them would do for new ones
    before = _resident_mb()
    assert _draw(people[1]) == 128
    grown = _resident_mb()
    bpy.data.batch_remove(parts_of(people[1]))
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    free_unused_grids()
    assert grown - before > 30, "a grid takes about 0.9 MB"
    assert _resident_mb() - before < 0.35 * (grown - before)
    assert _draw(people[0]) == 64


def test_the_users_preferences_are_as_before(empty_scene):
    system = bpy.context.preferences.system
    system.memory_cache_limit = 1234
    bpy.context.preferences.is_dirty = False
    free_unused_grids()
    assert (system.memory_cache_limit, bpy.context.preferences.is_dirty) == (1234, False)
    system.memory_cache_limit = 4096
