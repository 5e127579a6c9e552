"""Which Python runs the backend."""

import sys
from pathlib import Path

import pytest

from blender_primdiffusion.backend.environment import (
    MARK,
    NOT_INSTALLED,
    NOT_SET_UP,
    VARIABLE,
    BackendNotFound,
    candidates,
    find_python,
    python_of_environment,
)

PYTHON = Path(sys.executable)


@pytest.fixture(autouse=True)
def nothing_named(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


def test_the_running_python_will_do_where_it_has_torch():
    assert find_python(module_path=Path("bundled")) == ("Blender's own Python", PYTHON)


def test_the_preference_goes_before_the_variable_and_that_before_the_extensions_own(monkeypatch, tmp_path):
    own = python_of_environment(tmp_path)
    own.parent.mkdir()
    own.touch()
    (tmp_path / MARK).touch()
    assert [path for _, path in candidates(None, tmp_path)] == [own, PYTHON]
    monkeypatch.setenv(VARIABLE, "/by/variable")
    assert [path for _, path in candidates("", tmp_path)] == [Path("/by/variable")]
    assert [path for _, path in candidates("/by/preference", tmp_path)] == [Path("/by/preference")]


def test_a_program_that_the_user_has_installed_goes_before_blenders_own_python(tmp_path):
    program = tmp_path / "primdiffusion"
    assert [path for _, path in candidates(None, None, program)] == [program, PYTHON]
    assert list(candidates(None, None, own_python=False)) == []


@pytest.mark.parametrize(("bundled", "sentence"), [(None, NOT_INSTALLED), (Path("bundled"), NOT_SET_UP)])
def test_where_nothing_is_installed_one_sentence_says_what_to_do(monkeypatch, bundled, sentence):
    monkeypatch.setattr("blender_primdiffusion.backend.environment.own_python_has_backend", lambda _: False)
    with pytest.raises(BackendNotFound) as error:
        find_python(module_path=bundled)
    assert str(error.value) == sentence
    assert ". " not in sentence


def test_an_environment_of_the_extension_that_is_gone_is_passed_over(tmp_path):
    (tmp_path / MARK).touch()
    assert find_python(own_environment=tmp_path, module_path=Path("bundled"))[1] == PYTHON
