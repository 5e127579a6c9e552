"""A human's file is in the .blend, byte for byte, wherever the armature goes: undo, saving, copies, libraries."""

from __future__ import annotations

import os
import shutil

import bpy
from human_files import folder_of, forget_session_files, held, lose_data, person_file
from human_stage import build_posed, named, places, whole
from support.errors import refused

from blender_primdiffusion.jobs.volumes import faults
from blender_primdiffusion.scene.human import (
    BODY,
    BODY_MARK,
    PAYLOAD,
    body_of,
    session_folder,
)

ops = bpy.ops.primdiffusion
ODD = 'Ä ö\' "x" 100%s 年'


def reopened(path=None) -> bpy.types.Object:
    """Anna, from the .blend alone."""
    path = path or bpy.data.filepath
    forget_session_files()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return named()


def test_saved_under_another_name_elsewhere_and_then_moved(person, content, tmp_path):
    where, elsewhere = places(person), tmp_path / ODD
    elsewhere.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(elsewhere / "b.blend"))
    assert whole(named(), where)
    shutil.move(elsewhere / "b.blend", tmp_path / "c.blend")
    assert whole(reopened(tmp_path / "c.blend"), where)
    assert held(named()) == content
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["prepared", "source", elsewhere.name]


def test_a_file_never_saved_and_then_saved(source, content, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True)
    anna = build_posed(source)
    assert build_posed(source, "Berta")[BODY] == anna[BODY], "humans of one body hold it once"
    where = places(anna)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "new.blend"))
    assert whole(reopened(), where)
    assert held(named()) == content


def test_purging_and_packing_take_nothing_away(person, content):
    bpy.ops.outliner.orphans_purge(do_recursive=True)
    bpy.ops.file.pack_all()
    bpy.ops.wm.save_mainfile()
    assert held(reopened()) == content


def test_an_edit_packs_another_file_and_undo_and_redo_switch_it(person, content):
    bpy.ops.ed.undo_push(message="before")
    ops.vary(seed=12)
    edited = held(named())
    assert edited[0] != content[0]
    assert edited[1] == content[1]
    bpy.ops.ed.undo()
    assert held(named()) == content
    assert whole(named())
    bpy.ops.ed.redo()
    assert held(named()) == edited
    assert whole(named())
    bpy.ops.wm.save_mainfile()
    assert held(reopened()) == edited
    assert len([image for image in bpy.data.images if image.packed_file]) == 2, "the file before is not saved"


def test_unpacked_by_blender_the_file_is_the_same(person, content, tmp_path):
    person[PAYLOAD].unpack(method="WRITE_LOCAL")
    (written,) = [path for path in tmp_path.rglob("*") if path.is_file() and path.parent.name == "textures"]
    assert written.read_bytes() == content[0]


def test_files_of_the_session_are_written_again_where_they_are_removed(person, content):
    shutil.rmtree(folder_of(person))
    assert person_file(person).read_bytes() == content[0]
    assert person_file(person).with_name("body.safetensors").read_bytes() == content[1]
    assert folder_of(person).is_relative_to(session_folder())
    assert os.path.dirname(bpy.data.filepath) not in str(session_folder())


def test_a_human_without_data_is_named_in_one_sentence(person, capsys):
    lose_data(person)
    bpy.ops.wm.save_mainfile()
    anna = reopened()
    assert "'Anna' holds no data of a human" in faults.text
    assert capsys.readouterr().out.count("no data of a human") == 1
    assert not body_of(anna).hide_viewport
    assert BODY_MARK in body_of(anna)
    with refused(RuntimeError, "no data"):
        ops.vary(human="Anna")
