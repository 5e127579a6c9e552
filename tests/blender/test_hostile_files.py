"""Hostile files in every file picker: each is rejected in one sentence, and nothing is left of it in the .blend."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic_shape
from blend_tampering import COUNT, PROPERTIES, SECRET, Stage, build, in_preferences, panels_fault, person, tried
from exporting import write_person
from human_files import folder_of, paths_of, person_file
from scene_state import state
from support.errors import refused

from blender_primdiffusion.backend import environment
from blender_primdiffusion.backend.environment import BackendNotFound, candidates
from blender_primdiffusion.jobs.queue import chosen_checkpoint, queue
from blender_primdiffusion.jobs.steps import Session
from blender_primdiffusion.jobs.volumes import faults, write_before_rendering
from blender_primdiffusion.places import EXTENSION, preference
from blender_primdiffusion.scene import payload
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import body_of
from blender_primdiffusion.scene.payload import BODY, PAYLOAD, session_folder
from blender_primdiffusion.scene.volume_files import are_written
from blender_primdiffusion.ui.preferences import known

LONGEST_SENTENCE = 300
READS = {
    "import_motion": ("filepath", (".npz", ".npy", ".json", ".bvh", ".fbx")),
    "choose_picture": ("filepath", (".png", ".jpg")),
    "import_human": ("filepath", (".human", ".human.safetensors", ".npz")),
}
"""Operators that read a file: the property with its path, and endings."""
WRITES = [("export_motion", ".npz"), *(("export", ending) for ending in (".glb", ".ply", ".human", ".vdb"))]
"""Operators that write the file of their `filepath`."""
FOLDERS = {"set_up_backend"}
"""Operators on the folder of their `directory`."""
PATHS = {"FILE_PATH", "DIR_PATH", "FILE_NAME"}


def with_paths() -> dict[str, set[str]]:
    """Every operator with a path, and its properties of paths."""
    found = {}
    for name in dir(bpy.ops.primdiffusion):
        properties = getattr(bpy.ops.primdiffusion, name).get_rna_type().properties
        paths = {one.identifier for one in properties if one.type == "STRING" and one.subtype in PATHS}
        if paths:
            found[name] = paths
    return found


def contents() -> Iterator[tuple[str, bytes]]:
    noise = np.random.default_rng(0).integers(0, 256, 4096, np.uint8).tobytes()
    yield "empty", b""
    yield "noise", noise
    yield "deep", b"[" * 100_000
    yield "header", (2**62).to_bytes(8, "little") + noise
    yield "long line", b"x" * 2**20
    yield "code", b"import os\nos.mkdir('ran')\n"
    yield "zip", b"PK\x03\x04" + noise
    yield (
        "npy",
        b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 72), }" + b" " * 40,
    )
    yield "png", b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff\x08\x02\x00\x00\x00" + noise
    yield (
        "bvh",
        b"HIERARCHY\nROOT hips\n{\nOFFSET 0 0 0\nCHANNELS -2\n}\nMOTION\nFrames: 1000000000000\nFrame Time: 1e-320\n",
    )
    yield "human", b"\x02\x00\x00\x00\x00\x00\x00\x00{}"


def whole(ending: str, folder: Path) -> bytes:
    """A valid file, to be cut."""
    path = folder / f"whole{ending}"
    if ending == ".npz":
        np.savez(path, **synthetic_shape.arrays(8))
    elif ending in (".human", ".human.safetensors"):
        write_person(path)
    elif ending == ".npy":
        np.save(path, np.zeros((3, 72)))
    else:
        path.write_bytes(b"1 2 3 4")
    return path.read_bytes()


def hostile_files(folder: Path, ending: str) -> list[Path]:
    """Damaged files and things that are no files."""
    folder.mkdir()
    for name, content in contents():
        (folder / f"{name}{ending}").write_bytes(content)
    content = whole(ending, folder)
    (folder / f"whole{ending}").unlink()
    for share in (0.02, 0.3, 0.7):
        (folder / f"cut {share}{ending}").write_bytes(content[: int(share * len(content))])
    (folder / f"folder{ending}").mkdir()
    found = sorted(folder.iterdir())
    if os.name != "nt":
        os.mkfifo(folder / f"pipe{ending}")
        (folder / f"loop{ending}").symlink_to(folder / f"loop{ending}")
        (folder / f"device{ending}").symlink_to("/dev/zero")
        found += [folder / f"{name}{ending}" for name in ("pipe", "loop", "device")]
    return [*found, folder / f"nowhere{ending}", folder / f"{'n' * 240}{ending}"]


def fault(name: str, folder: Path, **properties: str) -> str:
    """What is wrong about an operator's answer to hostile files; empty if nothing is."""
    before = state()
    try:
        answer = getattr(bpy.ops.primdiffusion, name)(**properties)
    except RuntimeError as error:
        text = str(error).strip()
    else:
        return f"{name} {properties}: {answer}"
    sentence = re.sub(r"^(Error: |Warning: |Info: )", "", text).replace(str(folder), "")
    if "Traceback" in text or "\n" in sentence or len(sentence.split()) < 3:
        return f"{name} {properties}: no sentence: {text!r}"
    if len(sentence) > LONGEST_SENTENCE:
        return f"{name} {properties}: {len(sentence)} characters: {sentence!r}"
    changes = [(a, b) for a, b in zip(before, state(), strict=True) if a != b]
    return f"{name} {properties}: changed {changes}" if changes else ""


@pytest.fixture
def anna(addon, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    person = build_human(addon, synthetic_shape.write(tmp_path / "human", 8), "Anna")
    bpy.context.view_layer.objects.active = person
    bpy.context.scene.frame_end = 2
    bpy.ops.wm.save_mainfile()
    return tmp_path


@pytest.mark.usefixtures("addon")
def test_every_operator_with_a_path_gets_hostile_files():
    expected = {name.partition(" ")[0]: {shown} for name, (shown, _) in READS.items()}
    expected |= {name: {"filepath"} for name, _ in WRITES} | {name: {"directory"} for name in FOLDERS}
    assert with_paths() == expected


@pytest.mark.parametrize("name", READS)
def test_a_hostile_file_is_rejected_in_one_sentence_and_leaves_nothing(anna, name):
    shown, endings = READS[name]
    name, _, what = name.partition(" ")
    way = {"what": what} if what else {}
    faults = []
    for number, ending in enumerate(endings):
        folder = anna / str(number)
        faults += [fault(name, folder, **way, **{shown: str(path)}) for path in hostile_files(folder, ending)]
    assert not list(filter(None, faults)), "\n".join(filter(None, faults))
    assert not (anna / "ran").exists()


@pytest.mark.parametrize(("name", "ending"), WRITES)
def test_a_place_that_cannot_be_written_is_named_in_one_sentence(anna, name, ending):
    (anna / f"folder{ending}").mkdir()
    (anna / "file").write_bytes(b"a user's file")
    places = [f"folder{ending}", f"file/a{ending}", f"nowhere/a{ending}", f"{'n' * 300}{ending}", "file.txt/", ""]
    before = sorted(anna.rglob("*"))
    faults = [fault(name, anna, filepath=str(anna / place) if place else "") for place in places]
    assert not list(filter(None, faults)), "\n".join(filter(None, faults))
    assert sorted(anna.rglob("*")) == before
    assert (anna / "file").read_bytes() == b"a user's file"


@pytest.mark.parametrize("name", sorted(FOLDERS))
def test_a_folder_that_is_none_is_named_in_one_sentence(anna, name, monkeypatch):
    monkeypatch.setattr(Session, "follow", lambda *_: {"FINISHED"})
    (anna / "file").write_bytes(b"a user's file")
    faults = [fault(name, anna, directory=str(anna / place)) for place in ("file", "n" * 300, "nowhere")]
    assert not list(filter(None, faults)), "\n".join(filter(None, faults))
    assert (anna / "file").read_bytes() == b"a user's file"


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


def test_a_packed_file_above_the_limit_is_not_read(pristine, monkeypatch):
    bpy.ops.wm.open_mainfile(filepath=str(pristine.blend))
    monkeypatch.setattr(payload, "LARGEST_PERSON", 1000)
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
    found = known()
    assert not found.usable
    assert "depends on the file that is open" in found.line


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
