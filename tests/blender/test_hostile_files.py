"""Hostile files in every file picker: each is rejected in one sentence, and nothing is left of it in the .blend."""

from __future__ import annotations

import os
import re
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic_shape
from exporting import write_person
from scene_state import state

from blender_primdiffusion.scene.build import build_human

pytestmark = pytest.mark.any_blender

LONGEST_SENTENCE = 300
READS = {
    "import_motion": ("filepath", (".npz", ".npy", ".json", ".bvh", ".fbx")),
    "choose_picture": ("filepath", (".png", ".jpg")),
    "import_human": ("filepath", (".human", ".human.safetensors", ".npz")),
}
"""Operators that read a file: the property with its path, and endings."""
WRITES = [("export_motion", ".npz"), *(("export", ending) for ending in (".glb", ".ply", ".human"))]
"""Operators that write the file of their `filepath`."""
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


CONTENTS = {
    "empty": b"",
    "noise": np.random.default_rng(0).integers(0, 256, 4096, np.uint8).tobytes(),
    "deep": b"[" * 100_000,
    "header": (2**62).to_bytes(8, "little") + bytes(4096),
    "code": b"import os\nos.mkdir('ran')\n",
}
"""What each reader gets; what a file may claim of its own kind is for tests/contract/test_bad_files.py."""


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
    for name, content in CONTENTS.items():
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
    expected = {name: {shown} for name, (shown, _) in READS.items()}
    expected["choose_picture"] |= {"directory"}  # of several, as `filepath` each
    assert with_paths() == expected | {name: {"filepath"} for name, _ in WRITES}


@pytest.mark.parametrize("name", READS)
def test_a_hostile_file_is_rejected_in_one_sentence_and_leaves_nothing(anna, name):
    shown, endings = READS[name]
    faults = []
    for number, ending in enumerate(endings):
        folder = anna / str(number)
        faults += [fault(name, folder, **{shown: str(path)}) for path in hostile_files(folder, ending)]
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
