"""A stranger's .blend: whatever its names and paths are, saving it and pressing buttons changes nothing outside."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
from blend_tampering import PROPERTIES, SECRET, Stage, build, in_preferences, panels_fault, person, tried

from blender_primdiffusion.backend import environment
from blender_primdiffusion.backend.environment import BackendNotFound, candidates
from blender_primdiffusion.jobs.queue import chosen_checkpoint, queue
from blender_primdiffusion.places import EXTENSION, preference
from blender_primdiffusion.scene import merged
from blender_primdiffusion.scene.body_file import BODY_FILE
from blender_primdiffusion.scene.edit import edit_destination, replace_person
from blender_primdiffusion.scene.human import PERSON, VolumeWriteError, folder_of, person_file, volume_path
from blender_primdiffusion.scene.human_npz import write_now
from blender_primdiffusion.ui.setup import known


@pytest.fixture
def pristine(addon, tmp_path):
    queue.close()
    stage = Stage(tmp_path / "pristine")
    build(stage)
    with in_preferences():
        yield stage
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.parametrize("name", PROPERTIES)
def test_no_value_of_a_property_leaves_the_folder_or_raises(pristine, tmp_path, name):
    faults = {what: found for what, found in tried(name, pristine, tmp_path / "case") if found}
    assert not faults, "\n".join(f"{what}: {fault}" for what, found in faults.items() for fault in found)
    assert pristine.users.read_bytes() == SECRET


def test_saving_replaces_nothing_that_a_body_files_name_leads_to(pristine, capsys):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    person()[BODY_FILE] = "../../../.bashrc"
    bpy.ops.wm.save_mainfile()
    assert pristine.users.read_bytes() == SECRET
    assert "the custom property 'primdiffusion_body_file' of 'Anna' is ignored" in capsys.readouterr().out


def test_a_strangers_human_is_collected_where_its_names_are_right(pristine):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    bpy.ops.wm.save_mainfile()
    folder = pristine.humans / "Anna"
    assert {volume_path(volume).parent for volume in bpy.data.volumes} == {folder}
    assert person_file(person()) == folder / "person.human.safetensors"
    assert len(list(pristine.humans.glob("body_*.npz"))) == 1


@pytest.mark.parametrize("size", ["same", "other"])
def test_saving_replaces_no_file_of_another_content(pristine, capsys, size):
    (pristine.humans / "Anna").mkdir(parents=True)
    names = [f"Anna/{path.name}" for path in pristine.shipped.iterdir() if not path.is_symlink()]
    names += [path.name for path in pristine.shipped.parent.glob("body_*.npz")]
    for name in names:
        length = (pristine.shipped.parent / name).stat().st_size
        (pristine.humans / name).write_bytes(b"x" * (length if size == "same" else 3))
    before = {path: path.read_bytes() for path in pristine.humans.rglob("*") if path.is_file()}
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    bpy.ops.wm.save_mainfile()
    assert {path: path.read_bytes() for path in before} == before
    shown = capsys.readouterr().out
    assert ("is not replaced: move it away" in shown) == (size == "other")
    if size == "same":
        assert person()[PERSON] != "person.human.safetensors"
        assert person_file(person()).read_bytes() == (pristine.shipped / "person.human.safetensors").read_bytes()


def test_an_edit_writes_nothing_through_a_link_in_place_of_the_humans_folder(pristine, tmp_path):
    (tmp_path / "outside").mkdir()
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    pristine.humans.mkdir()
    folder_of(person()).symlink_to(tmp_path / "outside")
    with pytest.raises(VolumeWriteError, match="is a link to another folder"):
        replace_person(
            person(),
            write_now(pristine.source / "human.npz", edit_destination(person())),
            pristine.source / "person.human.safetensors",
        )
    with pytest.raises(VolumeWriteError, match="is a link to another folder"):
        merged.publish([pristine.source / "grid.vdb"], ["a"], merged.merged_folder(person()))
    assert not list((tmp_path / "outside").iterdir())


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
    with pytest.raises(BackendNotFound, match="depends on the file that is open"):
        list(candidates(preference("backend_python"), None))
    monkeypatch.undo()  # the fixture's search
    with pytest.raises(BackendNotFound, match="depends on the file that is open"):
        list(environment.search(preference("backend_python")))
    found = known.known()
    assert not found.usable
    assert "depends on the file that is open" in found.line
    with pytest.raises(RuntimeError, match="depends on the file that is open"):
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
    with pytest.raises(ValueError, match=f"name a {name} by '//model.safetensors', which depends on the file"):
        chosen_checkpoint(name)
    assert not panels_fault()
    setattr(preferences, name, "/models/a.safetensors")
    assert chosen_checkpoint(name) == "/models/a.safetensors"
