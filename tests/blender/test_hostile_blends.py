"""A stranger's .blend: whatever its names and paths are, saving it and pressing buttons changes nothing outside."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy
import pytest
from blend_tampering import COUNT, PROPERTIES, SECRET, Stage, build, in_preferences, panels_fault, person, tried
from blender_primdiffusion.formats.regular_files import FileError
from support.errors import refused

from blender_primdiffusion.backend import environment
from blender_primdiffusion.backend.environment import BackendNotFound, candidates
from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes, write_before_rendering
from blender_primdiffusion.jobs.queue import chosen_checkpoint, queue
from blender_primdiffusion.places import EXTENSION, preference
from blender_primdiffusion.scene import collect, merged
from blender_primdiffusion.scene.edit import replace_person
from blender_primdiffusion.scene.human import (
    armature_of,
    folder_of,
    humans_folder,
    person_file,
    volume_path,
    volumes_of,
)
from blender_primdiffusion.scene.pending import pending_of
from blender_primdiffusion.scene.states import prepare_now
from blender_primdiffusion.ui.setup import known


@pytest.fixture
def pristine(addon, tmp_path):
    queue.close()
    stage = Stage(tmp_path / "pristine")
    build(stage)
    with in_preferences():
        yield stage
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.any_blender  # properties are read alike by all; the tests below save and open files on each
@pytest.mark.parametrize("name", PROPERTIES)
def test_no_value_of_a_property_leaves_the_folder_or_raises(pristine, tmp_path, name):
    faults = {what: found for what, found in tried(name, pristine, tmp_path / "case") if found}
    assert not faults, "\n".join(f"{what}: {fault}" for what, found in faults.items() for fault in found)
    assert pristine.users.read_bytes() == SECRET


def test_a_strangers_human_is_collected_where_its_names_are_right(pristine):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    bpy.ops.wm.save_mainfile()
    folder = pristine.humans / "Anna" / "0002"  # this Blender has built the stranger's human as 0001
    primitives = [volume_path(obj.data) for objects in volumes_of(person()).values() for obj in objects]
    assert {path.parent for path in primitives} == {folder}
    assert person_file(person()) == folder / "person.human.safetensors"
    assert (folder / "body.safetensors").is_file()


@pytest.mark.parametrize("size", ["same", "other"])
def test_saving_replaces_no_file_of_another_content(pristine, size):
    there = pristine.humans / "Anna" / "0001"
    there.mkdir(parents=True)
    for path in pristine.shipped.iterdir():
        if not path.is_symlink():
            (there / path.name).write_bytes(b"x" * (path.stat().st_size if size == "same" else 3))
    before = {path: path.read_bytes() for path in pristine.humans.rglob("*") if path.is_file()}
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    bpy.ops.wm.save_mainfile()
    assert {path: path.read_bytes() for path in before} == before
    assert person_file(person()).parent == pristine.humans / "Anna" / "0002"
    assert person_file(person()).read_bytes() == (pristine.shipped / "person.human.safetensors").read_bytes()


def test_an_edit_writes_nothing_through_a_link_in_place_of_the_humans_folder(pristine, tmp_path):
    (tmp_path / "outside").mkdir()
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    pristine.humans.mkdir()
    folder_of(person()).symlink_to(tmp_path / "outside")
    with refused(FileError):
        replace_person(person(), prepare_now(pristine.source / "person.human.safetensors", replaced=person()))
    with refused(FileError):
        merged.publish([pristine.source / "grid.vdb"], ["a"], merged.merged_folder(person()))
    assert not list((tmp_path / "outside").iterdir())


def elsewhere(stage: Stage, place: str) -> Path:
    """A .blend whose human is in a folder of the user's, where its volumes are still to be written."""
    folder = {"temporary": stage.shipped, "named": stage.root / "home" / ".config" / "Anna" / "0001"}[place]
    bpy.ops.wm.open_mainfile(filepath=str(stage.blend))
    if folder != stage.shipped:
        folder.parent.mkdir(parents=True)
        shutil.move(stage.shipped, folder)
        for volume in bpy.data.volumes:
            volume.filepath = str(folder / Path(volume.filepath).name)
    names = sorted(path.name for path in folder.glob("prim_*.vdb") if not path.is_symlink())
    for name in names:
        (folder / name).unlink()
    saving = bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:]
    bpy.app.handlers.save_pre.clear()  # the stranger has no extension
    bpy.app.handlers.save_post.clear()
    bpy.ops.wm.save_mainfile()
    bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:] = saving
    assert len(names) == COUNT
    return folder


def by_timer() -> None:
    while deferred_volumes.work(0.0):
        pass


WRITERS = {
    "timer": by_timer,
    "render": lambda: write_before_rendering(bpy.context.scene),
    "viewport": lambda: bpy.ops.primdiffusion.volumes_in_viewport(),
    "save": lambda: (bpy.ops.wm.save_mainfile(), by_timer()),
    "undo": lambda: (bpy.ops.ed.undo_push(), bpy.ops.ed.undo_push(), bpy.ops.ed.undo(), by_timer()),
}


@pytest.mark.parametrize("place", ["temporary", "named"])
@pytest.mark.parametrize("writer", WRITERS)
def test_no_volume_is_written_in_a_folder_that_a_blend_merely_names(pristine, writer, place):
    folder = elsewhere(pristine, place)
    before = pristine.before()
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    bpy.context.view_layer.objects.active = armature_of(person())
    WRITERS[writer]()
    primitives = [volume_path(obj.data) for objects in volumes_of(person()).values() for obj in objects]
    own = pristine.humans if writer == "save" else humans_folder("")
    assert len(primitives) == COUNT
    assert all(path.is_file() and path.is_relative_to(own) for path in primitives)
    assert not pristine.changed_outside(before)
    assert (folder / "person.human.safetensors").is_file(), "the stranger's file stays"
    assert pending_of(person()) is None
    assert not deferred_volumes.error


@pytest.mark.parametrize("link", [False, True])
def test_no_volume_is_written_beside_a_blend_that_a_human_is_appended_or_linked_from(pristine, link):
    elsewhere(pristine, "named")
    before = pristine.before()
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(pristine.blend), link=link) as (_, wanted):
        wanted.collections = ["Anna"]
    bpy.context.scene.collection.children.link(bpy.data.collections["Anna"])
    by_timer()
    paths = [volume_path(obj.data) for objects in volumes_of(person()).values() for obj in objects]
    assert len(paths) == COUNT
    assert all(path.is_file() and path.is_relative_to(humans_folder("")) for path in paths)
    assert person_file(person()).is_file()
    assert pristine.before() == before


def test_nothing_is_written_through_a_link_in_place_of_a_folder_of_volumes(pristine, tmp_path):
    folder = elsewhere(pristine, "named")
    pristine.humans.mkdir()
    (pristine.humans / "Anna").symlink_to(folder.parent)
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    for volume in bpy.data.volumes:
        volume.filepath = str(pristine.humans / "Anna" / "0001" / Path(volume.filepath).name)
    before = pristine.before()
    by_timer()
    assert pristine.before() == before
    assert volume_path(bpy.data.volumes[0]).is_relative_to(humans_folder(""))


def test_a_folder_that_cannot_be_copied_is_told_once(pristine, monkeypatch, capsys):
    elsewhere(pristine, "named")
    before = pristine.before()

    def full(*_: object, **__: object) -> bool:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(collect, "copy_file", full)
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    by_timer()
    by_timer()
    assert "No space left" in deferred_volumes.error
    assert capsys.readouterr().out.count("No space left") == 1
    assert pristine.before() == before


@pytest.fixture
def beside(pristine):
    """A program beside the open file that tells when it is run; and the preferences."""
    program = pristine.project / "python"
    program.write_text(f"#!/bin/sh\necho run > {pristine.root}/ran\n")
    program.chmod(0o700)
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    yield pristine, bpy.context.preferences.addons[EXTENSION].preferences
    assert not (pristine.root / "ran").exists()


RELATIVE = ["//python", "python", "./python", "../project/python", "//../project/python", r"\\host\share\python"]


@pytest.mark.parametrize("named", RELATIVE)
def test_a_python_beside_the_file_is_not_run_and_the_preferences_say_why(beside, named, monkeypatch):
    stage, preferences = beside
    monkeypatch.chdir(stage.project)
    preferences.backend_python = named
    with refused(BackendNotFound):
        list(candidates(preference("backend_python"), None))
    monkeypatch.undo()  # the fixture's search
    with refused(BackendNotFound):
        list(environment.search(preference("backend_python")))
    found = known.known()
    assert not found.usable
    assert "depends on the file that is open" in found.line
    with refused(RuntimeError, "depends"):
        bpy.ops.primdiffusion.test_backend()


def test_a_python_with_its_whole_path_is_taken(beside):
    _, preferences = beside
    preferences.backend_python = "/opt/python"
    assert list(candidates(preference("backend_python"), None)) == [
        ("the extension's preferences", Path("/opt/python"))
    ]


@pytest.mark.parametrize("name", ["checkpoint", "encoder"])
def test_a_model_beside_the_file_is_not_taken(beside, name):
    _, preferences = beside
    setattr(preferences, name, "//model.safetensors")
    with refused(ValueError, name, "'//model.safetensors'"):
        chosen_checkpoint(name)
    assert not panels_fault()
    setattr(preferences, name, "/models/a.safetensors")
    assert chosen_checkpoint(name) == "/models/a.safetensors"
