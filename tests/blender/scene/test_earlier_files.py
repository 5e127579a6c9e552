"""A .blend whose humans have files named by hashes opens once more, and is converted when it is saved."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from human_stage import COUNT, named, places, whole
from support import tensor_files

from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes
from blender_primdiffusion.scene.collect import unused
from blender_primdiffusion.scene.human import (
    HOME,
    folder_of,
    humans_folder,
    person_file,
    state_folder,
    volume_path,
    volumes_of,
)
from blender_primdiffusion.scene.rest_human import shape_model_of

ops = bpy.ops.primdiffusion
_PERSON, _BODY = "primdiffusion_person_file", "primdiffusion_body_file"


def hashed(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def as_earlier(person, *, edited: bool = False) -> Path:
    """Lay a human's files out as the versions before folders of states did, in a .blend that they have saved."""
    state, folder = state_folder(person), folder_of(person)
    for k, objects in volumes_of(person).items():
        path = volume_path(objects[0].data)
        name = f"prim_{k:04d}_{hashed(path)}.vdb"
        path.rename(folder / name)
        objects[0].data.filepath = f"//shot_humans/Anna/{name}"
    own = state / "person.human.safetensors"
    if edited:
        person[_PERSON] = f"person_{hashed(own)}.human.safetensors"
        shutil.copy(own, folder / "person.human.safetensors")  # of the state before
    own.rename(folder / (person[_PERSON] if edited else own.name))
    body = state / tensor_files.BODY
    person[_BODY] = f"body_{hashed(body)}.npz"
    arrays, _ = tensor_files.read_tensors(body)
    integers = {name: arrays[name].astype(np.uint16) for name in ("faces", "face", "stencil_vertex")}
    np.savez(folder.parent / person[_BODY], **{**arrays, **integers})
    body.unlink()
    state.rmdir()
    person[HOME] = str(folder)
    handlers = bpy.app.handlers.save_pre[:]
    bpy.app.handlers.save_pre.clear()  # as the earlier version, which knows no folders of states
    bpy.ops.wm.save_mainfile()
    bpy.app.handlers.save_pre[:] = handlers
    return folder


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(params=["made", "edited"])
def earlier(person, request):
    """The human's folder, and where its volumes are."""
    where = places(person)
    return as_earlier(person, edited=request.param == "edited"), where


def test_it_opens_and_saving_converts_it(earlier):
    folder, where = earlier
    before = content(folder.parent)
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)
    assert state_folder(named()).is_relative_to(humans_folder(""))
    assert content(folder.parent) == before, "opening changes nothing beside the .blend"
    bpy.ops.wm.save_mainfile()
    state = state_folder(named())
    assert state.parent == folder
    assert {volume.filepath for volume in bpy.data.volumes} == {
        f"//shot_humans/Anna/{state.name}/prim_{k:04d}.vdb" for k in range(COUNT)
    }
    assert not {_PERSON, _BODY} & set(named().keys())
    shutil.rmtree(humans_folder(""))
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)
    assert person_file(named()).parent == state
    assert shape_model_of(named()).template.shape == (736, 3)
    assert set(unused(humans_folder())) == set(before)
    assert ops.remove_unused_files() == {"FINISHED"}
    assert whole(named(), where)


def test_volumes_that_were_still_to_be_written_are_written(person):
    folder = as_earlier(person)
    for path in sorted(folder.glob("prim_*"))[1:]:
        path.unlink()
    (folder / "unwritten_0123456789ab.npz").write_bytes(b"what they were to be written from")
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    while deferred_volumes.work(0.0):
        pass
    assert whole(named())
    assert folder / "unwritten_0123456789ab.npz" in unused(humans_folder())


@pytest.mark.parametrize("link", [False, True])
def test_appended_and_linked_humans_are_converted_for_the_session(earlier, tmp_path, link):
    folder, where = earlier
    before, blend = content(folder.parent), bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    operator = bpy.ops.wm.link if link else bpy.ops.wm.append
    options = {"instance_collections": False} if link else {}
    operator(directory=str(Path(blend) / "Collection") + os.sep, filename="Anna", **options)
    assert whole(named(), where)
    assert content(folder.parent) == before


def test_a_human_whose_own_file_is_gone_keeps_its_volumes(person):
    folder = as_earlier(person)
    (folder / "person.human.safetensors").unlink()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.ops.wm.save_mainfile()
    assert all(volume.grids.load() for volume in bpy.data.volumes)
    assert len(list(state_folder(named()).glob("prim_*.vdb"))) == COUNT


def test_links_among_the_files_of_a_stranger_are_not_followed(person, tmp_path):
    folder = as_earlier(person)
    mine = tmp_path / "mine"
    mine.write_text("mine")
    for path in (folder / "person.human.safetensors", next(folder.glob("prim_*")), next(folder.parent.glob("body_*"))):
        path.unlink()
        path.symlink_to(mine)
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.ops.wm.save_mainfile()
    copies = [path for path in humans_folder().rglob("*") if path.is_file() and not path.is_symlink()]
    assert not [path for path in copies if path.read_bytes() == b"mine"]
