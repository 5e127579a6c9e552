import os
import pickle

import pytest
from primdiffusion.files.regular_files import (
    FileError,
    as_file_error,
    check_unlinked,
    open_to_append,
    portable_name,
    remove_file,
    remove_folder,
)
from support.errors import refused


@pytest.mark.parametrize("name", ["CON", "aux", "nul.png", "Com1", "lpt9.tar.gz", "anna. ", "con . "])
def test_a_name_that_windows_does_not_take_is_changed_so_that_it_does(name):
    made = portable_name(name)
    assert made != name
    assert made == portable_name(made)
    assert made.split(".")[0].lower() not in {"con", "prn", "aux", "nul", "com1", "lpt9"}
    assert made[-1] not in ". "


@pytest.mark.parametrize("name", ["anna", "Connor", "console", "nulla.png", "com10", "human.001", "lpt"])
def test_other_names_stay(name):
    assert portable_name(name) == name


@pytest.mark.parametrize("error", [ValueError, IndexError, TypeError, AttributeError, OverflowError])
def test_what_damaged_content_raises_names_the_file_once_and_what_to_do(error):
    with pytest.raises(FileError) as caught, as_file_error("a.json", "is damaged", "write it again"):
        raise error("a.json: two\nlines")
    assert str(caught.value) == "a.json is damaged (two lines): write it again"
    assert (caught.value.path, caught.value.remedy) == ("a.json", "write it again")


def test_an_error_is_pickled_with_its_three_parts(tmp_path):
    error = pickle.loads(pickle.dumps(FileError(tmp_path, "is damaged", "write it again")))
    assert (error.path, error.reason, error.remedy) == (tmp_path, "is damaged", "write it again")
    assert str(error) == f"{tmp_path} is damaged: write it again"


@pytest.mark.parametrize(
    ("error", "also"),
    [(OSError("because"), ()), (RuntimeError("because"), (OSError,)), (FileError("b.npz", "is cut", "copy it"), ())],
)
def test_errors_that_are_not_of_content_or_name_a_file_pass(error, also):
    with pytest.raises(type(error)) as caught, as_file_error("a.json", "is damaged", "write it again", *also):
        raise error
    assert caught.value is error


def test_a_missing_key_is_named():
    with refused(FileError, "a.json", "'voxels'"), as_file_error("a.json", "is damaged", "write it again"):
        raise KeyError("voxels")


def test_other_errors_are_named_where_the_caller_says_so():
    with pytest.raises(FileError), as_file_error("a.json", "is damaged", "write it again", OSError):
        raise OSError


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
    for path in (tmp_path / "link", tmp_path / "dangling", tmp_path):
        with refused(FileError, path.name):
            open_to_append(path)
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
