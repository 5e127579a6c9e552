"""Removal that stays within a folder."""

import os

import pytest
from primdiffusion.formats.regular_files import FileError, check_unlinked, remove_file, remove_folder
from support.errors import refused


@pytest.fixture
def linked(tmp_path):
    """A folder with a link to another one, in which a file of the user lies."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "mine").write_text("mine")
    (tmp_path / "dataset").mkdir()
    (tmp_path / "dataset" / "extra").symlink_to(tmp_path / "outside")
    return tmp_path / "dataset"


@pytest.mark.parametrize("remove", [remove_file, remove_folder])
@pytest.mark.parametrize("name", ["extra/mine", "../outside/mine", "extra/..", ""])
def test_nothing_outside_is_removed(linked, remove, name):
    with pytest.raises(FileError):
        remove(linked / name, linked)
    assert (linked.parent / "outside" / "mine").read_text() == "mine"


def test_of_a_link_the_link_is_removed(linked):
    remove_folder(linked / "extra", linked)
    remove_file(linked / "extra", linked)
    assert not (linked / "extra").is_symlink()
    assert (linked.parent / "outside" / "mine").exists()


def test_a_folder_that_is_reached_by_a_link_is_emptied(linked):
    remove_file(linked / "extra" / "mine", linked / "extra")
    assert not (linked.parent / "outside" / "mine").exists()


def test_links_to_folders_are_found_before_anything_is_written(linked):
    check_unlinked(linked.parent / "outside")
    for folder in (linked, linked / "extra"):
        with refused(FileError):
            check_unlinked(folder)


def test_links_in_a_circle_are_an_error_of_files(tmp_path):
    (tmp_path / "circle").symlink_to("circle")
    with refused(OSError, "circle"):
        remove_file(tmp_path / "circle" / "x", tmp_path)
    remove_file(tmp_path / "circle", tmp_path)
    assert not os.path.lexists(tmp_path / "circle")
