"""Every promise of SECURITY.md on files has a test, and what it says of sizes, programs and writing holds."""

from __future__ import annotations

import ast
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy  # noqa: F401  before the rest, which it would otherwise load anew
import numpy as np
import pytest

from fuzz.run import ROOT
from fuzz.target import Target
from fuzz.test_not_files import FILES, outcome

PAGE = ROOT / "SECURITY.md"
FUZZ = "tests/fuzz/test_short_fuzz.py::test_damaged_files_end_in_a_sentence_or_are_read"
HERE = "tests/fuzz/test_promises.py::"
BLENDS = "tests/blender/test_hostile_blends.py::"
ALL = {
    "Nothing in a file is run": (FUZZ, f"{HERE}test_reading_runs_nothing_and_writes_nothing"),
    "Reading writes nothing": (f"{HERE}test_reading_runs_nothing_and_writes_nothing",),
    "No connection": (
        f"{HERE}test_reading_runs_nothing_and_writes_nothing",
        "tests/backend/formats/test_json_files.py::test_paths_of_other_machines_and_devices_are_not_plain",
    ),
    "Regular files only": ("tests/fuzz/test_not_files.py::test_what_is_no_file_is_rejected_at_once",),
    "One open file": (
        "tests/fuzz/test_not_files.py::test_every_module_that_reads_a_file_is_tried",
        "tests/backend/primitives/test_body_setup.py::test_what_was_hashed_is_loaded_after_the_files_have_changed",
        "tests/backend/test_torch_file.py::test_a_file_that_is_overwritten_after_the_check_is_not_loaded",
        "tests/backend/test_tensor_file.py::test_what_is_overwritten_later_is_not_read",
    ),
    "Size": (f"{HERE}test_a_file_that_is_larger_than_promised_is_rejected_unread",),
    "Memory": (
        "tests/fuzz/test_small_inputs.py::test_small_inputs_take_little_memory_and_are_read_or_rejected_in_a_sentence",
    ),
    "Time": (FUZZ,),
    "One sentence": (
        FUZZ,
        "tests/blender/test_hostile_files.py::test_a_hostile_file_is_rejected_in_one_sentence_and_leaves_nothing",
    ),
}  # fmt: skip
"""Tests of the promises on all files, which are the list in SECURITY.md."""
ROWS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "names and paths in a `.blend`": (
        (),
        (
            f"{BLENDS}test_no_value_of_a_property_leaves_the_folder_or_raises",
            f"{BLENDS}test_no_volume_is_written_in_a_folder_that_a_blend_merely_names",
            f"{BLENDS}test_saving_replaces_no_file_of_another_content",
            f"{BLENDS}test_a_python_beside_the_file_is_not_run_and_the_preferences_say_why",
        ),
    ),
    "humans `.human`, `.human.safetensors`, their `body.safetensors`": (
        (
            "human", "compact human", "human in Blender", "compact human in Blender", "moving human in Blender",
            "small human in Blender", "body file",
        ),
        ("tests/backend/test_human_file.py::test_a_damaged_file_is_rejected_by_name_with_its_damage",),
    ),
    "networks and training states `.safetensors`": (
        (
            "checkpoint", "encoder", "attribute network", "joints network", "training state", "vocabulary",
            "run: latents", "hub: weights",
        ),
        (
            "tests/backend/diffusion/test_checkpoint.py::test_a_network_larger_than_its_file_is_not_built",
            "tests/backend/diffusion/test_checkpoint.py::test_weights_that_are_not_numbers_are_named",
            "tests/contract/test_tensor_layout.py::test_damaged_files_get_the_librarys_verdict",
        ),
    ),
    "torch's `.pt`, `.pth`": (
        ("released checkpoint", "network .pth"),
        (
            "tests/backend/test_torch_file.py::test_a_hostile_pickle_is_refused_before_it_is_run",
            "tests/backend/test_torch_file.py::test_a_tensor_is_no_larger_than_the_numbers_in_the_file",
            "tests/backend/test_torch_file.py::test_the_public_loader_gets_the_checked_members_alone",
        ),
    ),
    "SMPL bodies `.pkl`, `.npz`, poses `.pkl`": (
        ("SMPL .npz", "SMPL .pkl", "poses .pkl"),
        (
            "tests/backend/body/test_smpl_files.py::test_hostile_pickle_is_rejected_by_name_and_does_not_run",
            "tests/backend/body/test_smpl_files.py::test_npz_with_pickled_objects_is_rejected",
        ),
    ),
    "their texture coordinates `.obj`": (
        ("UV .obj",),
        ("tests/backend/body/test_smpl_files.py::test_wrong_paths_and_texture_files_are_named",),
    ),
    "arrays `.npz`: motion, AMASS, captures, payloads, bodies of earlier `.blend` files": (
        (
            "AMASS", "poses .npz", "pose .npz", "MHR .npz", "parameters of a scan", "captures: poses",
            "captures: pickled poses",
            "captures: joints", "payload", "payload of a gallery", "fitted voxels", "painted weights", "solids",
            "body of captures", "proxy", "merged grid",
        ),
        (
            "tests/backend/formats/test_arrays.py::test_arrays_of_one_call_share_the_limit",
            "tests/blender/motion/test_files.py::test_a_zip_bomb_is_rejected",
            "tests/backend/capture/test_reader.py::test_a_pickle_that_would_run_code_is_rejected",
        ),
    ),
    "arrays `.npy`: motion, depth": (
        ("poses .npy", "motion .npy", "depth of a shot"),
        ("tests/blender/motion/test_files.py::test_an_array_larger_than_its_file_is_rejected_before_memory_is_taken",),
    ),
    "JSON: poses, cameras, captures, sets of humans": (
        (
            "pose", "own pose", "poses .json", "motion .json", "MHR .json", "cameras", "human's card",
            "manifest", "packed index", "joints of shots", "captures: settings", "captures: cameras",
            "captures: completion mark", "captures: about a pack", "posture",
        ),
        (
            "tests/backend/formats/test_json_files.py::test_what_no_reader_can_use_is_one_short_reason",
            "tests/backend/training/test_shards.py::test_an_index_names_only_files_beside_it",
            "tests/backend/capture/test_reader.py::test_a_list_that_names_folders_outside_is_rejected",
        ),
    ),
    "motion `.bvh`": (
        ("BVH", "motion .bvh"),
        ("tests/blender/motion/test_bvh.py::test_broken_files_are_named",),
    ),
    "meshes of humans `.glb`": (
        ("glb",),
        ("tests/backend/capture/test_people_files.py::test_a_small_file_cannot_name_endless_parts",),
    ),
    "assets `.mhclo`, `.obj`": (
        ("mhclo", "obj"),
        ("tests/backend/people/test_mhclo.py::test_damaged_mhclo_is_rejected",),
    ),
    "lists of licences and captures": (
        ("licences", "captures: list"),
        ("tests/backend/capture/test_reader.py::test_a_list_that_names_folders_outside_is_rejected",),
    ),
    "pictures PNG, JPEG, WebP": (
        (
            "picture", "shot", "captures: picture", "captures: first picture", "plain picture", "texture of an asset",
            "background of captures",
        ),
        ("tests/backend/geometry/test_pictures.py::test_a_large_picture_in_a_small_file_is_rejected_by_its_header_and_a_large_file_may_have_it",),
    ),
    "shards of humans": (
        ("packed shard",),
        ("tests/backend/training/test_shards.py::test_a_shard_with_the_right_checksum_and_other_tensors_is_rejected",),
    ),
    "run folders: settings, metrics": (
        ("run: settings", "run: starts", "run: metrics"),
        ("tests/backend/test_folder_lock.py::test_of_two_processes_the_second_is_rejected_in_one_sentence",),
    ),
    "requirements in a folder of wheels": (
        ("lock of packages",),
        (
            "tests/contract/test_setup_environment.py::test_a_wheel_that_is_not_the_locked_one_is_not_installed",
            "tests/contract/test_setup_environment.py::test_pip_gets_the_lock_as_it_was_checked",
            "tests/contract/test_setup_environment.py::test_a_pipe_among_the_wheels_is_named_before_anything_is_made",
        ),
    ),
    "folders of the hub: the name of the commit": (
        ("hub: commit",),
        ("tests/backend/diffusion/test_pretrained.py::test_a_folder_without_one_model_is_refused",),
    ),
    "messages of the child process": (
        (),
        (
            "tests/contract/test_client_messages.py::test_a_malformed_message_ends_the_child_with_a_sentence",
            "tests/contract/test_client.py::test_a_flood_without_a_line_end_takes_no_memory_and_what_follows_is_heard",
        ),
    ),
    "requests to the child process": (
        (),
        (
            "tests/contract/test_protocol.py::test_a_malformed_line_gets_one_error_and_the_conversation_goes_on",
            "tests/fuzz/test_short_fuzz.py::test_every_request_of_the_child_is_damaged",
        ),
    ),
}  # fmt: skip
"""Kinds of files of the table in SECURITY.md: what tries each in `test_not_files`, and tests of what it says."""
TRUSTED = {
    "ONNX network", "Blender: preview", "Blender: HDRI", "Blender: picture of a scan", "Blender: plain picture",
    "Blender: scan", "shape of a scan", "picture of Cycles", "frame", "captures: pack",
    "material of an asset",
}  # fmt: skip
"""Files without a largest size: what Blender and onnxruntime read by themselves, what this program has just written,
and those of which only the head is read, or which are mapped."""
UNITS = {"KB": 2**10, "MB": 2**20, "GB": 2**30}


def table() -> dict[str, str]:
    """Kinds of files in SECURITY.md, with the largest size."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    first = lines.index("| files | largest | checked before use |") + 2
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[first:] if line.startswith("|")]
    assert all(len(row) == 3 and all(row) for row in rows)
    return {row[0]: row[1] for row in rows}


def promised_for_all() -> list[str]:
    """What the list in SECURITY.md begins with."""
    return re.findall(r"^- \*\*(.+?)\.?\*\*", PAGE.read_text(encoding="utf-8"), re.MULTILINE)


def size(text: str) -> int:
    number, unit = text.split()[:2]
    return int(number) * UNITS[unit]


def names_of_tests(path: str) -> set[str]:
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}


def test_every_promise_has_a_test_that_exists():
    assert list(table()) == list(ROWS)
    assert promised_for_all() == list(ALL)
    for promise, tests in {**ALL, **{row: tests for row, (_, tests) in ROWS.items()}}.items():
        assert tests, promise
        for test in tests:
            path, _, name = test.partition("::")
            assert (ROOT / path).is_file(), test
            assert name in names_of_tests(path), test


def test_every_file_that_is_read_is_in_a_row_or_trusted():
    tried = [name for targets, _ in ROWS.values() for name in targets]
    assert len(set(tried)) == len(tried)
    assert {*tried, *TRUSTED} == {target.name for target in FILES}
    assert not TRUSTED & set(tried)


SIZED = [(row, name) for row, (targets, _) in ROWS.items() for name in targets]
AS_ABSENT = {"captures: completion mark", "captures: about a pack"}
"""Files that count as missing where they are too large."""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("files")


def made(target: Target, place: Path, monkeypatch) -> Path:
    folder = place / str(len(list(place.iterdir())))
    folder.mkdir()
    monkeypatch.chdir(folder)
    return target.make(folder)


@pytest.mark.parametrize(("row", "name"), SIZED, ids=[name for _, name in SIZED])
def test_a_file_that_is_larger_than_promised_is_rejected_unread(row, name, place, monkeypatch):
    target = next(target for target in FILES if target.name == name)
    path = made(target, place, monkeypatch)
    os.truncate(path, size(table()[row]) + 1)  # takes no room
    assert outcome(target, path, path.parents[0]) == ("read" if name in AS_ABSENT else "rejected")


PROGRAMS = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "pty.spawn")
NETWORK = ("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.sendto")
WRITES = (
    "os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod",
    "shutil.rmtree", "shutil.copyfile", "shutil.move",
)  # fmt: skip
_seen: list[str] | None = None


def note(event: str, arguments: tuple[object, ...]) -> None:
    """The audit hook, which Python keeps for ever: it notes what is done while `_seen` is a list."""
    if _seen is None:
        return
    where = next((argument for argument in arguments if isinstance(argument, str | Path)), "")
    is_cache = "__pycache__" in str(where) or "numba" in str(where)  # of compiled kernels
    writes = event in WRITES or (
        event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    )
    if (event in PROGRAMS + NETWORK or writes) and not is_cache:
        _seen.append(f"{event} {where}")


@pytest.fixture(scope="module")
def hook() -> None:
    sys.addaudithook(note)


WRITERS = {
    "run: settings", "run: starts", "run: metrics", "frame", "Blender: preview",
    "packed shard",
}  # fmt: skip
"""What is read by commands that write as well, a file that is shared with Blender, and what Blender reads. The reading
of a shard writes its new hash."""


def damaged(target: Target, content: bytes) -> Iterator[bytes]:
    yield content
    rng = np.random.default_rng(0)
    for mutation in target.mutations[:3]:
        try:
            yield mutation(content, rng)
        except Exception:  # nothing to damage
            continue


@pytest.mark.usefixtures("hook")
@pytest.mark.parametrize("target", [one for one in FILES if one.name not in WRITERS], ids=lambda target: target.name)
def test_reading_runs_nothing_and_writes_nothing(target, place, monkeypatch):
    global _seen
    path = made(target, place, monkeypatch)
    outcome(target, path, path.parent)  # modules and kernels are loaded
    content = path.read_bytes()
    found: list[str] = []
    for one in damaged(target, content):
        path.write_bytes(one)
        _seen = []
        try:
            outcome(target, path, path.parent)
        finally:
            found, _seen = [*found, *_seen], None
    assert not found


def test_the_hook_sees(tmp_path, hook):
    global _seen
    _seen = []
    try:
        (tmp_path / "a").write_text("x")
        (tmp_path / "a").rename(tmp_path / "b")
        (tmp_path / "b").unlink()
        os.system("true")
        found = _seen
    finally:
        _seen = None
    assert [line.split()[0] for line in found] == ["open", "os.rename", "os.remove", "os.system"]
