"""Volumes in a format of a newer Blender are written again from the human's own file, and this is said once."""

from __future__ import annotations

import struct

import bpy
import numpy as np
import pytest
import synthetic_shape
from support.errors import refused

from blender_primdiffusion.jobs import deferred_volumes as module
from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes
from blender_primdiffusion.jobs.missing_files import look, state
from blender_primdiffusion.scene import pending
from blender_primdiffusion.scene.attachment import show_in_viewport
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.copies import duplicate_human
from blender_primdiffusion.scene.human import humans, person_file, volume_path
from blender_primdiffusion.scene.volumes import format_of, openvdb, readable_format

COUNT = 5
ops = bpy.ops.primdiffusion


def as_if_newer(path) -> None:
    """A file as this Blender sees one of a newer Blender: the header says so, and its trees are unknown."""
    content = path.read_bytes()
    newer = content[:8] + struct.pack("<I", readable_format() + 1) + content[12:].replace(b"Tree_", b"Trex_")
    path.unlink()
    path.write_bytes(newer)


def grids(path) -> list[np.ndarray]:
    """Values of the density and the colour where the file has any."""
    low, high = np.full(3, -2), np.full(3, 12)
    values = []
    for grid in openvdb().readAll(str(path))[0]:
        shape = (*(high - low), 3) if grid.name == "Cd" else tuple(high - low)
        values.append(np.zeros(shape, np.float32))
        grid.copyToArray(values[-1], ijk=tuple(int(i) for i in low))
        values.append(np.array([grid.transform.indexToWorld(tuple(map(float, corner))) for corner in np.eye(3)]))
    return values


def files() -> list:
    return sorted({volume_path(volume) for volume in bpy.data.volumes})


def unreadable() -> list:
    return [path for path in files() if format_of(path) > readable_format()]


@pytest.fixture
def saved(addon, tmp_path):
    """The grids, by file, of a human in a saved .blend whose files a newer Blender has written."""
    build_human(bpy.context, synthetic_shape.write(tmp_path / "human", COUNT), "Anna")
    bpy.ops.wm.save_mainfile()
    before = {path: grids(path) for path in files()}
    assert len(before) == COUNT
    for path in before:
        as_if_newer(path)
    return before


def reopened(capsys) -> str:
    """What opening the file says."""
    capsys.readouterr()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    return capsys.readouterr().out


def check_written(before) -> None:
    """The files that volumes name hold what they held, and Blender reads them."""
    assert not unreadable()
    for path, values in before.items():
        for value, expected in zip(grids(path), values, strict=True):
            np.testing.assert_allclose(value, expected, atol=2e-3)
    assert all(volume.grids.load() and len(volume.grids) == 2 for volume in bpy.data.volumes)
    look()
    assert state.summary == ""


def test_this_blender_cannot_read_them(saved):
    with refused(Exception, "read"):
        grids(next(iter(saved)))


def test_a_render_writes_them_again_and_it_is_said_once(saved, capsys):
    paths = {volume.name: volume.filepath for volume in bpy.data.volumes}
    said = reopened(capsys)
    assert said.count("newer Blender") == 1
    assert f"Volumes of 'Anna' are in a format of a newer Blender ({readable_format() + 1}" in said
    assert "newer Blender" in deferred_volumes.notice
    module.write_before_rendering(bpy.context.scene)
    assert deferred_volumes.notice == ""
    assert "newer Blender" not in capsys.readouterr().out
    assert {volume.name: volume.filepath for volume in bpy.data.volumes} == paths
    check_written(saved)
    assert "newer Blender" not in reopened(capsys)


def test_the_timer_writes_them_again(saved, capsys):
    reopened(capsys)
    steps = 0
    while deferred_volumes.work(0.0):
        steps += 1
    assert steps > COUNT
    assert deferred_volumes.notice == ""
    check_written(saved)


def test_only_what_cannot_be_read_is_written(saved, capsys):
    reopened(capsys)
    deferred_volumes.finish()
    first, *others = files()
    as_if_newer(first)
    inodes = [path.stat().st_ino for path in others]
    assert "Volumes of" in reopened(capsys)
    deferred_volumes.finish()
    assert [path.stat().st_ino for path in others] == inodes
    check_written(saved)


@pytest.mark.parametrize("how", ["append", "link", "instance"])
def test_appended_or_linked_they_are_written_in_copies(saved, capsys, how):
    blend, stored = bpy.data.filepath, {path: path.read_bytes() for path in saved}
    bpy.ops.wm.read_homefile(use_empty=True)
    capsys.readouterr()
    operator = bpy.ops.wm.append if how == "append" else bpy.ops.wm.link
    operator(directory=f"{blend}/Collection/", filename="Anna", instance_collections=how == "instance")
    assert capsys.readouterr().out.count("newer Blender") == 1
    deferred_volumes.finish()
    values = {path.name: held for path, held in saved.items()}
    assert not set(files()) & set(saved)
    check_written({path: values[path.name] for path in files()})
    assert {path: path.read_bytes() for path in saved} == stored


def test_two_humans_with_the_same_files_are_one_line(saved, capsys):
    duplicate_human(humans(bpy.context.scene)[0])
    bpy.ops.wm.save_mainfile()
    said = reopened(capsys)
    assert said.count("newer Blender") == 1
    assert "'Anna', 'Anna.001'" in said
    while deferred_volumes.work(0.0):
        pass
    check_written(saved)


def test_volumes_that_viewports_show_are_seen_at_once(saved, capsys):
    person = humans(bpy.context.scene)[0]
    bpy.context.view_layer.layer_collection.children["Anna"].exclude = True  # or Blender would read the files
    show_in_viewport(person, True)
    bpy.ops.wm.save_mainfile()
    assert "newer Blender" in reopened(capsys)
    assert not unreadable()
    bpy.context.view_layer.layer_collection.children["Anna"].exclude = False
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    shown = [instance.object for instance in graph.object_instances if instance.object.type == "VOLUME"]
    assert len(shown) == COUNT
    assert all(obj.data.grids.load() for obj in shown)
    check_written(saved)


def test_the_file_of_another_human_is_reported(saved, capsys, tmp_path):
    own, other = person_file(humans(bpy.context.scene)[0]), synthetic_shape.write(tmp_path / "other", 3)
    for path in (own, own.with_name("body.safetensors")):
        path.write_bytes(other.with_name(path.name).read_bytes())
    reopened(capsys)
    deferred_volumes.finish()
    assert "cannot be written" in deferred_volumes.error
    assert len(unreadable()) == COUNT


def test_a_full_disk_is_reported_and_the_files_stay(saved, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    reopened(capsys)
    monkeypatch.setattr(pending, "write_volume", full)
    while deferred_volumes.work(0.0):
        pass
    assert "free space" in deferred_volumes.error
    assert capsys.readouterr().out.count("free space") == 1
    assert len(unreadable()) == COUNT
    monkeypatch.undo()
    deferred_volumes.finish()
    assert deferred_volumes.error == ""
    check_written(saved)
