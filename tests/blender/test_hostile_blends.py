"""A stranger's .blend: whatever its names, paths and packed files are, opening and saving it and pressing buttons
changes nothing outside."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
import pytest
from blend_tampering import COUNT, PROPERTIES, SECRET, Stage, build, in_preferences, panels_fault, person, tried
from human_files import folder_of, paths_of, person_file
from support.errors import refused

from blender_primdiffusion.backend import environment
from blender_primdiffusion.backend.environment import BackendNotFound, candidates
from blender_primdiffusion.jobs.queue import chosen_checkpoint, queue
from blender_primdiffusion.jobs.volumes import faults, write_before_rendering
from blender_primdiffusion.places import EXTENSION, preference
from blender_primdiffusion.scene import human
from blender_primdiffusion.scene.human import BODY, PAYLOAD, body_of, session_folder
from blender_primdiffusion.scene.volume_nodes import are_written
from blender_primdiffusion.ui.preferences import known


@pytest.fixture
def pristine(addon, tmp_path):
    queue.close()
    stage = Stage(tmp_path / "pristine")
    build(stage)
    with in_preferences():
        yield stage
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.any_blender  # properties are read alike by all; the tests below save and open files on each
@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", PROPERTIES)
def test_no_value_of_a_property_leaves_the_folder_or_raises(pristine, tmp_path, name, every):
    faults = {what: found for what, found in tried(name, pristine, tmp_path / "case", every) if found}
    assert not faults, "\n".join(f"{what}: {fault}" for what, found in faults.items() for fault in found)
    assert pristine.users.read_bytes() == SECRET


WRITERS = {
    "render": lambda: write_before_rendering(bpy.context.scene),
    "viewport": lambda: bpy.ops.primdiffusion.volumes_in_viewport(),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_no_volume_is_read_or_written_in_a_folder_that_a_blend_names(pristine, writer):
    before = pristine.before()
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    bpy.context.view_layer.objects.active = person()
    WRITERS[writer]()
    assert len(paths_of(person())) == COUNT
    assert all(path.is_file() and path.is_relative_to(session_folder()) for path in paths_of(person()))
    assert pristine.before() == before
    assert are_written(person())
    assert not faults.text


@pytest.mark.parametrize("link", [False, True])
def test_no_volume_is_written_beside_a_blend_that_a_human_is_appended_or_linked_from(pristine, link):
    before = pristine.before()
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(pristine.blend), link=link) as (_, wanted):
        wanted.collections = ["Anna"]
    bpy.context.scene.collection.children.link(bpy.data.collections["Anna"])
    write_before_rendering(bpy.context.scene)
    assert len(paths_of(person())) == COUNT
    assert all(path.is_file() and path.is_relative_to(session_folder()) for path in paths_of(person()))
    assert pristine.before() == before


def another(data: bytes) -> bpy.types.Image:
    image = bpy.data.images.new("foreign", 1, 1)
    image.pack(data=data, data_len=len(data))
    return image


def damage(kind: str) -> None:
    """As a stranger's file has it."""
    armature = person()
    whole = armature[PAYLOAD].packed_file.data
    if kind in ("missing", "old"):
        del armature[PAYLOAD]
    elif kind == "text":
        armature[PAYLOAD] = "/etc/passwd"
    elif kind == "unpacked":
        armature[PAYLOAD] = bpy.data.images.new("empty", 1, 1)
    elif kind == "no body":
        del armature[BODY]
    elif kind == "body damaged":
        armature[BODY] = another(b"no body")
    else:
        content = {"cut": whole[:-50], "noise": os.urandom(500), "empty header": b"\0" * 100, "endless": whole[:8] * 99}
        armature[PAYLOAD] = another(content[kind])


DAMAGED = ("missing", "text", "unpacked", "no body", "body damaged", "cut", "noise", "empty header", "endless")


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_or_foreign_packed_file_shows_the_body_and_is_told_once(pristine, kind, capsys):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    damage(kind)
    bpy.ops.wm.save_mainfile()
    before = pristine.before()
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    assert not body_of(person()).hide_viewport
    assert "the human 'Anna' cannot be drawn" in faults.text
    assert "\n" not in faults.text
    assert not panels_fault()
    assert capsys.readouterr().out.count("cannot be drawn") == 1
    assert pristine.before() == before


@pytest.mark.any_blender
def test_a_packed_file_above_the_limit_is_not_read(pristine, monkeypatch):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    monkeypatch.setattr(human, "LARGEST_PERSON", 1000)
    with refused(ValueError, "holds no data"):
        person_file(person())


def test_a_whole_file_in_place_of_the_damaged_one_is_drawn_again(pristine):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    whole = person_file(person()).read_bytes()
    person()[PAYLOAD] = another(b"noise")
    assert person_file(person()).read_bytes() == b"noise"
    person()[PAYLOAD] = another(whole)
    assert person_file(person()).read_bytes() == whole
    assert folder_of(person()).is_relative_to(session_folder())


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


@pytest.mark.any_blender
@pytest.mark.parametrize("named", RELATIVE)
def test_a_python_beside_the_file_is_not_run_and_the_preferences_say_why(beside, named, monkeypatch):
    stage, preferences = beside
    monkeypatch.chdir(stage.project)
    preferences.backend_python = named
    with refused(BackendNotFound):
        list(candidates(preference("backend_python"), None))
    monkeypatch.undo()  # the fixture's own find_python
    with refused(BackendNotFound):
        environment.find_python(preference("backend_python"))
    found = known()
    assert not found.usable
    assert "depends on the file that is open" in found.line


@pytest.mark.any_blender
def test_a_python_with_its_whole_path_is_taken(beside):
    _, preferences = beside
    preferences.backend_python = "/opt/python"
    assert list(candidates(preference("backend_python"), None)) == [
        ("the extension's preferences", Path("/opt/python"))
    ]


@pytest.mark.any_blender
def test_a_model_beside_the_file_is_not_taken(beside):
    _, preferences = beside
    preferences.checkpoint = "//model.safetensors"
    with refused(ValueError, "checkpoint", "'//model.safetensors'"):
        chosen_checkpoint()
    assert not panels_fault()
    preferences.checkpoint = "/models/a.safetensors"
    assert chosen_checkpoint() == "/models/a.safetensors"
