"""Which Python runs the backend."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from support.errors import refused
from tiny_packages import until
from waiting import run_to_end

from blender_primdiffusion.backend.client import BackendClient
from blender_primdiffusion.backend.environment import (
    MARK,
    NOT_INSTALLED,
    TRIAL,
    VARIABLE,
    BackendNotFound,
    ImportTimedOut,
    candidates,
    python_of_environment,
    search,
    tried,
)

PYTHON = Path(sys.executable)


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.fixture(autouse=True)
def nothing_tried(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    tried.clear()


@pytest.fixture
def bundled(tmp_path) -> Path:
    """A folder with a backend and a torch that are imported at once."""
    folder = tmp_path / "bundled"
    (folder / "primdiffusion").mkdir(parents=True)
    (folder / "primdiffusion" / "__init__.py").write_text("__version__ = 'bundled'")
    (folder / "torch.py").write_text("__version__ = '2'")
    return folder


def test_the_running_python_will_do_where_it_has_torch():
    found = run_to_end(search())
    assert found.path == PYTHON
    assert found.source == "Blender's own Python"
    assert found.torch[0].isdigit()
    assert found.version


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


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
def test_an_installed_program_is_tried_and_serves(tmp_path):
    program = script(tmp_path / "primdiffusion", f'exec {PYTHON} -m primdiffusion "$@"')
    found = run_to_end(search(installed=program))
    assert (found.path, found.source) == (program, "the PATH")
    assert found.torch[0].isdigit()
    client = BackendClient(program)
    client.start()
    until(lambda: client.poll() is not None and client.info.get("version") == found.version)
    client.shutdown()


def test_where_nothing_is_installed_one_sentence_says_what_to_do(monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.backend.environment.own_python_has_backend", lambda: False)
    with pytest.raises(BackendNotFound) as error:
        run_to_end(search())
    assert str(error.value) == NOT_INSTALLED
    assert ". " not in NOT_INSTALLED


def test_a_wish_that_fails_is_an_error_and_not_replaced_by_another_python(tmp_path):
    with refused(BackendNotFound, "no-python"):
        run_to_end(search(tmp_path / "no-python"))


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
@pytest.mark.parametrize(
    ("text", "timeout_s", "reason"),
    [
        ("echo \"ModuleNotFoundError: No module named 'torch'\" >&2; exit 1", 300.0, "No module named 'torch'"),
        ("exec sleep 600", 1.0, "did not import torch within 1 s"),
        ("echo hello", 300.0, "no Python interpreter"),
    ],
)
def test_a_python_that_will_not_do_is_named_with_its_reason_and_what_to_do(tmp_path, text, timeout_s, reason):
    python = script(tmp_path / "python", text)
    with pytest.raises(BackendNotFound) as error:
        run_to_end(search(python, timeout_s=timeout_s))
    assert reason in str(error.value)
    assert str(python) in str(error.value)
    assert "preferences" in str(error.value)


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
def test_a_python_that_took_too_long_may_be_tried_again(tmp_path):
    with refused(ImportTimedOut) as error:
        run_to_end(search(script(tmp_path / "python", "exec sleep 600"), timeout_s=0.1))
    assert error.value.kind == "timeout"


def test_a_python_counts_as_tried_once_it_has_answered(bundled, tmp_path):
    broken = tmp_path / "no-python"
    assert PYTHON not in tried
    run_to_end(search(PYTHON, module_path=bundled))
    with pytest.raises(BackendNotFound):
        run_to_end(search(broken))
    assert (tried[PYTHON], tried[broken]) == (True, False)


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
def test_a_broken_environment_of_the_extension_is_passed_over(bundled, tmp_path):
    script(python_of_environment(tmp_path), "exit 1")
    (tmp_path / MARK).touch()
    assert run_to_end(search(own_environment=tmp_path, module_path=bundled)).path == PYTHON


def test_an_old_python_is_reported():
    old = "import sys; sys.version_info = (3, 9); "
    done = subprocess.run([sys.executable, "-c", old + TRIAL], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "it is Python 3.9, and 3.11 or newer is needed\n"


def test_a_folder_is_no_python(tmp_path):
    with refused(BackendNotFound):
        run_to_end(search(tmp_path))


def test_the_bundled_package_is_the_one_that_is_tried(bundled):
    assert run_to_end(search(PYTHON, module_path=bundled)).version == "bundled"
