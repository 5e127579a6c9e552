"""Removal and writing that stay within a folder."""

import os

import pytest
from primdiffusion.files.regular_files import FileError, check_unlinked, open_to_append, remove_file, remove_folder
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


def test_links_within_a_folder_are_no_reason_to_reject_it(tmp_path):
    (tmp_path / "run-1").mkdir()
    (tmp_path / "latest").symlink_to("run-1")
    (tmp_path / "state").symlink_to(tmp_path.parent / "file of another run")
    check_unlinked(tmp_path)


def test_lines_are_added_to_a_regular_file_alone(tmp_path):
    for _ in range(2):
        with open_to_append(tmp_path / "lines") as file:
            file.write(b"one\n")
    assert (tmp_path / "lines").read_bytes() == b"one\none\n"
    (tmp_path / "link").symlink_to(tmp_path / "lines")
    (tmp_path / "dangling").symlink_to(tmp_path / "new")
    for name in ("link", "dangling"):
        with refused(FileError, name):
            open_to_append(tmp_path / name)
    with refused(OSError, tmp_path.name):
        open_to_append(tmp_path)
    assert (tmp_path / "lines").read_bytes() == b"one\none\n"
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_no_line_is_added_to_a_pipe_and_no_reader_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with refused(OSError, "pipe"):
        open_to_append(tmp_path / "pipe")


def test_links_in_a_circle_are_an_error_of_files(tmp_path):
    (tmp_path / "circle").symlink_to("circle")
    with refused(OSError, "circle"):
        remove_file(tmp_path / "circle" / "x", tmp_path)
    remove_file(tmp_path / "circle", tmp_path)
    assert not os.path.lexists(tmp_path / "circle")
