import pickle

import pytest
from primdiffusion.files.regular_files import FileError, as_file_error, portable_name
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


def test_an_error_that_names_a_file_passes():
    with pytest.raises(FileError) as caught, as_file_error("a.json", "is damaged", "write it again"):
        raise FileError("b.npz", "is cut short", "copy it again")
    assert (caught.value.path, caught.value.reason) == ("b.npz", "is cut short")


def test_an_error_is_pickled_with_its_three_parts(tmp_path):
    error = pickle.loads(pickle.dumps(FileError(tmp_path, "is damaged", "write it again")))
    assert (error.path, error.reason, error.remedy) == (tmp_path, "is damaged", "write it again")
    assert str(error) == f"{tmp_path} is damaged: write it again"


@pytest.mark.parametrize(("error", "also"), [(OSError, ()), (RuntimeError, (OSError,))])
def test_errors_that_are_not_of_content_pass(error, also):
    with pytest.raises(error) as caught, as_file_error("a.json", "is damaged", "write it again", *also):
        raise error("because")
    assert str(caught.value) == "because"


def test_a_missing_key_is_named():
    with refused(FileError, "a.json", "'voxels'"), as_file_error("a.json", "is damaged", "write it again"):
        raise KeyError("voxels")


def test_other_errors_are_named_where_the_caller_says_so():
    with pytest.raises(FileError), as_file_error("a.json", "is damaged", "write it again", OSError):
        raise OSError
