import pytest
from primdiffusion.formats.regular_files import portable_name


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
