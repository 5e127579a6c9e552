"""Datasets verified and repaired, without any rendering."""

import contextlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from primdiffusion.files.picture_files import write_png
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import capture_layout
from primdiffusion.formats.capture_repair import list_subjects, repair, verify
from support.errors import refused


@pytest.fixture
def root(tmp_path) -> Path:
    """A dataset of two finished subjects, each with one mask."""
    root = tmp_path / "captures"
    capture_layout.claim(root, {"frames": 1, "rig": {"count": 1}, "passes": ["mask"]})
    for name in ("anna", "bert"):
        write_png(capture_layout.picture_path(root / name, "mask", 0, 0), np.zeros((4, 4), np.uint8))
        capture_layout.complete(root / name)
    list_subjects(root)
    return root


def test_packed_arrays_and_the_released_reference_are_no_subjects(root):
    (root / "packed").mkdir()
    shutil.copytree(root / "anna", root / capture_layout.RELEASED_REFERENCE)
    list_subjects(root)
    assert verify(root) == {}
    assert (root / capture_layout.LIST_FILE).read_text().split() == ["anna", "bert"]


def test_a_list_that_names_an_unfinished_subject_is_reported_and_repaired(root):
    (root / "bert" / capture_layout.COMPLETE_FILE).unlink()
    (root / "bert" / "cameras.json").touch()
    assert verify(root) == {
        root / "bert": "not finished: 1 of 1 pictures are there",
        root / capture_layout.LIST_FILE: "differs from the finished subjects by bert",
    }
    repair(root, verify(root))
    assert (root / capture_layout.LIST_FILE).read_text().split() == ["anna"]


def test_a_partial_file_is_removed_without_rendering_the_subject_again(root):
    partial = root / "anna" / "mask" / ".0000.7.partial.png"
    partial.touch()
    assert verify(root) == {}  # another machine may still write it
    os.utime(partial, (0, 0))
    wrong = verify(root)
    assert wrong == {partial: "left behind by a killed process"}
    repair(root, wrong)
    assert verify(root) == {}


@pytest.mark.parametrize("place", ["anna/extra", "anna/mask", "carl"])
def test_no_file_behind_a_link_is_removed(root, tmp_path, place):
    """complete.json names a file through a link; a pass or a subject is a link."""
    outside = tmp_path / "outside"
    (outside / "camera0000").mkdir(parents=True)
    mine = outside / "camera0000" / "0000.png"
    mine.write_text("mine")
    (outside / capture_layout.COMPLETE_FILE).write_text('{"camera0000/0000.png": [9, 9]}')
    if place == "anna/mask":
        shutil.rmtree(root / place)
    (root / place).symlink_to(outside)
    if place == "anna/extra":
        (root / "anna" / capture_layout.COMPLETE_FILE).write_text('{"extra/camera0000/0000.png": [9, 1]}')
    wrong = verify(root)
    with contextlib.suppress(FileError):
        repair(root, wrong)
    assert mine.read_text() == "mine"
    assert (outside / capture_layout.COMPLETE_FILE).exists()


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"a": [1e999, 2]}',
        '{"a\\u0000b": [1, 2]}',
        '{"a": 3}',
        '{"mask/camera0000/0000.png": [1e300, 0]}',
    ],
)
def test_a_mark_that_cannot_be_used_leaves_its_subject_unfinished(root, text):
    (root / "anna" / capture_layout.COMPLETE_FILE).write_text(text)
    assert "not finished" in verify(root)[root / "anna"]


@pytest.mark.parametrize(
    "about", [{"frames": 10**6, "rig": {"count": 10**6}}, {"rig": "x"}, {"passes": [["img"]]}, {"passes": ["img"] * 99}]
)
def test_a_dataset_that_cannot_be_is_named(root, about):
    file = root / capture_layout.DATASET_FILE
    file.write_text(json.dumps({**json.loads(file.read_text()), **about}))
    with refused(FileError, "dataset.json"):
        verify(root)


@pytest.mark.parametrize("finished", [True, False])
def test_a_pipe_in_place_of_a_picture_is_damage(root, finished):
    path = capture_layout.picture_path(root / "anna", "mask", 0, 0)
    path.unlink()
    os.mkfifo(path)
    if not finished:
        (root / "anna" / capture_layout.COMPLETE_FILE).unlink()
    wrong = verify(root)
    assert wrong
    repair(root, wrong)
    assert path.exists() is not finished


def test_files_without_end_are_not_read(root):
    for name in ("anna/big.bin", capture_layout.LIST_FILE):
        with (root / name).open("wb") as file:
            file.truncate(capture_layout.LARGEST_FILE + 1)
    mark = root / "anna" / capture_layout.COMPLETE_FILE
    mark.write_text(json.dumps({**json.loads(mark.read_text()), "big.bin": [capture_layout.LARGEST_FILE + 1, 0]}))
    wrong = verify(root)
    assert wrong == {root / "anna" / "big.bin": "larger than 512 MB", root / capture_layout.LIST_FILE: "cannot be read"}
    repair(root, wrong)
    assert not (root / "anna" / "big.bin").exists()
    assert (root / capture_layout.LIST_FILE).read_text() == "bert\n"
