"""A person as one volume: what the files hold, what is shown, names, stale poses, material."""

import contextlib
import hashlib

import bpy
import numpy as np
import pytest
import synthetic
from blender_primdiffusion.files.regular_files import FileError
from human_files import sequence_files, volume_path
from support.errors import refused

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.merged import (
    MergedGrid,
    MergedState,
    merged_folder,
    merged_of,
    merged_state,
    pose_digest,
    publish,
    read_grid,
    remove_merged,
    show_merged,
    write_grid,
)
from blender_primdiffusion.scene.representation import (
    representation_of,
    set_representation,
    show_in_viewport,
    stop_showing,
)
from blender_primdiffusion.scene.volume_nodes import volume_material, write_volumes

bpy.utils.expose_bundled_modules()
import openvdb  # noqa: E402


def grid(seed: int = 0) -> MergedGrid:
    rng = np.random.default_rng(seed)
    density = np.zeros((20, 12, 9), np.float16)
    density[3:15, 2:10, 2:7] = rng.uniform(1, 90, (12, 8, 5))
    colour = np.zeros((20, 12, 9, 3), np.float16)
    colour[2:16, 1:11, 1:8] = rng.uniform(0.1, 1, (14, 10, 7, 3))
    return MergedGrid(density, colour, np.array([-0.3, 0.2, 0.6]), 0.02)


@pytest.fixture
def person(saved_scene, tmp_path):
    person = build_human(saved_scene, synthetic.write(tmp_path / "human", 6))
    write_volumes(person)
    show_in_viewport(person, True)
    return person


def merge(person, tmp_path, seeds=(0,), start=0) -> bpy.types.Object:
    written = [tmp_path / f"grid_{seed}.vdb" for seed in seeds]
    digests = [write_grid(grid(seed), path) for seed, path in zip(seeds, written, strict=True)]
    files = publish(written, digests, merged_folder())
    return show_merged(person, files, MergedState(tuple(f"pose {seed}" for seed in seeds), 0.02, start))


def visible_volumes() -> set[str]:
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    return {i.object.original.name for i in graph.object_instances if i.object.type == "VOLUME" and i.show_self}


def test_openvdb_reads_back_what_was_merged(tmp_path):
    merged = grid()
    origin = merged.origin
    write_grid(merged, tmp_path / "m.vdb")
    for name, values in (("density", merged.density), ("Cd", merged.colour)):
        read = openvdb.read(str(tmp_path / "m.vdb"), name)
        found = np.zeros(values.shape, np.float32)
        read.copyToArray(found)
        np.testing.assert_array_equal(found, values.astype(np.float32))
        assert read.saveFloatAsHalf
        np.testing.assert_allclose(read.transform.indexToWorld((0, 0, 0)), origin, atol=1e-7)
        np.testing.assert_allclose(read.transform.indexToWorld((1, 2, 3)), origin + np.array([0.02, 0.04, 0.06]))
    box = openvdb.read(str(tmp_path / "m.vdb"), "density").evalActiveVoxelBoundingBox()
    assert box == ((3, 2, 2), (14, 9, 6))  # what is empty is not stored


def test_a_merged_person_is_one_volume_and_goes_back(person, tmp_path):
    merged = merge(person, tmp_path)
    set_representation(person, "MERGED")
    assert visible_volumes() == {merged.name}
    assert merged.data.materials[0] == volume_material()
    assert merged.data.filepath.startswith("//shot_volumes/merged_")
    assert merged.data.grids.load(), merged.data.grids.error_message
    assert {one.name for one in merged.data.grids} == {"density", "Cd"}
    stop_showing(person, "MERGED")
    remove_merged(person)
    assert (representation_of(person), merged_of(person)) == ("VOLUMES", None)
    assert visible_volumes() == {"Human_volumes"}


def test_a_merged_person_moves_with_the_armature_object(person, tmp_path):
    merged = merge(person, tmp_path)
    armature = merged.parent
    armature.location, armature.rotation_euler = (1, 2, 3), (0.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(np.array(merged.matrix_world), np.array(armature.matrix_world), atol=1e-6)


@pytest.mark.any_blender
def test_another_grid_has_another_name_and_the_same_one_the_same(person, tmp_path):
    first = volume_path(merge(person, tmp_path).data)
    assert volume_path(merge(person, tmp_path).data) == first
    other = volume_path(merge(person, tmp_path, (1,)).data)
    assert other != first
    assert first.is_file()  # undo goes back to it


def test_a_sequence_shows_the_grid_of_its_frame(person, tmp_path):
    merged = merge(person, tmp_path, (0, 1, 2), start=10)
    assert merged_state(merged) == MergedState(("pose 0", "pose 1", "pose 2"), 0.02, 10)
    volume = merged.data
    assert volume.is_sequence
    assert [path.name[-9:] for path in sequence_files(volume)] == ["_0001.vdb", "_0002.vdb", "_0003.vdb"]
    scene = bpy.context.scene
    for frame, shown in ((10, 0), (11, 1), (12, 2), (20, 2), (3, 0)):
        scene.frame_set(frame)
        evaluated = merged.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        evaluated.grids.load()
        assert evaluated.grids.frame_filepath.endswith(f"_{shown + 1:04d}.vdb"), frame


@pytest.mark.any_blender
def test_a_merge_knows_the_pose_it_shows(person):
    rng = np.random.default_rng(0)
    joints = rng.normal(size=(24, 3, 4)).astype(np.float32)
    digest = pose_digest(person, joints, None)
    assert pose_digest(person, joints.astype(np.float32).tolist(), None) == digest
    assert pose_digest(person, joints + 1e-3, None) != digest
    assert pose_digest(person, joints, [0.5] * 10) != digest
    single, several = MergedState((digest,), 0.006), MergedState(("a", digest), 0.006, 5)
    assert single.shows(digest, 77)
    assert not single.shows("a", 77)
    assert [several.shows(digest, frame) for frame in (4, 5, 6, 7)] == [False, False, True, True]


@pytest.mark.any_blender
def test_a_folder_that_cannot_be_written_leaves_nothing(person, tmp_path):
    digest = write_grid(grid(), tmp_path / "grid.vdb")
    (tmp_path / "file").write_text("in the way")
    with refused(FileError):
        publish([tmp_path / "grid.vdb"], [digest], tmp_path / "file" / "folder")
    with refused(FileError):
        publish([tmp_path / "grid.vdb", tmp_path / "missing.vdb"], [digest, "x"], tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())


@pytest.mark.any_blender
@pytest.mark.parametrize(
    "change", [{"density": np.nan}, {"colour": np.inf}, {"voxel": 0.0}, {"origin": 1e39}, b"PK", b""]
)
def test_a_grid_is_read_as_the_child_wrote_it_or_rejected(tmp_path, change):
    path, merged = tmp_path / "merged.npz", grid()
    np.savez(path, **vars(merged))
    read = read_grid(path)
    np.testing.assert_array_equal(read.density, merged.density)
    assert read.voxel == 0.02
    if isinstance(change, bytes):
        path.write_bytes(change)
    else:
        np.savez(
            path, **vars(merged) | {name: np.full_like(vars(merged)[name], value) for name, value in change.items()}
        )
    with refused(ValueError, path.name):
        read_grid(path)


@pytest.mark.any_blender
@pytest.mark.parametrize("outside", ["mine", "nothing", "."])
def test_links_in_place_of_merged_files_lose_nothing_outside(tmp_path, outside):
    (tmp_path / "outside").mkdir()
    mine = tmp_path / "outside" / "mine"
    mine.write_text("mine")
    sources = [tmp_path / "a.vdb", tmp_path / "lost.vdb"]
    sources[0].write_text("a")
    digest = hashlib.sha256(b"ab").hexdigest()[:12]
    folder = tmp_path / "humans"
    folder.mkdir()
    for number in (1, 2):
        (folder / f"merged_{digest}_{number:04d}.vdb").symlink_to(mine.parent / outside)
    with contextlib.suppress(FileError):
        publish(sources, ["a", "b"], folder)
    assert [path.name for path in mine.parent.iterdir()] == ["mine"]
    assert mine.read_text() == "mine"
