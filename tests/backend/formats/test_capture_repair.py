"""Datasets verified and repaired, without any rendering."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from primdiffusion.formats import capture_layout
from primdiffusion.formats.capture_repair import list_subjects, repair, verify
from primdiffusion.formats.picture_files import write_png


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
    wrong = verify(root)
    assert wrong == {partial: "left behind by a killed process"}
    repair(root, wrong)
    assert verify(root) == {}


@pytest.mark.parametrize("about", [{"frames": 0}, {"rig": {}}, {"passes": "mask"}, {"passes": ["x-ray"]}])
def test_settings_that_do_not_describe_captures_are_rejected(tmp_path, about):
    capture_layout.claim(tmp_path, {"frames": 1, "rig": {"count": 1}, "passes": ["mask"], **about})
    with pytest.raises(capture_layout.CaptureFolderError):
        verify(tmp_path)
