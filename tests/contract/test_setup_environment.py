"""The private environment: real venv, pip and hash checks on tiny wheels."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import NamedTuple

import psutil
import pytest
from blender_primdiffusion.files.whole_files import write_atomically
from support.errors import refused
from support.fake_child import FAKE_CHILD
from tiny_packages import own_index, served, until, with_this_pip, write_lock, write_packages, write_wheel
from waiting import BACKEND, PYTHON, run_to_end

from blender_primdiffusion.backend import setup
from blender_primdiffusion.backend.client import BackendClient
from blender_primdiffusion.backend.environment import MARK, VARIABLE, SetUpFolder, candidates, state_of
from blender_primdiffusion.backend.packages import read_lock
from blender_primdiffusion.backend.requests import Backend, ChildRequest, Steps


class Place(NamedTuple):
    """What a set-up is made of."""

    folder: SetUpFolder
    wheels: Path
    lock: Path
    cache: Path

    def from_folder(self) -> Steps:
        return self._set_up(self.wheels)

    def from_index(self) -> Steps:
        return self._set_up(None)

    def _set_up(self, wheels: Path | None) -> Steps:
        return setup.set_up(self.folder, read_lock(self.lock), "cpu", FAKE_CHILD, self.cache, wheels)


@pytest.fixture
def place(tmp_path, monkeypatch) -> Place:
    """A folder with a space and an umlaut, and one of wheels."""
    monkeypatch.delenv(VARIABLE, raising=False)
    own_index(monkeypatch)
    with_this_pip(monkeypatch, setup)
    lock = write_lock(tmp_path / "lock.txt", write_packages(tmp_path / "räder"))
    root = tmp_path / "Menschen für Blender"
    return Place(SetUpFolder(root), tmp_path / "räder", lock, root / "cache")


def done(steps: Steps) -> str:
    """How it ended."""
    return run_to_end(steps)


def failed(steps: Steps) -> str:
    """The sentence of a set-up that fails."""
    with pytest.raises(RuntimeError) as error:
        done(steps)
    return str(error.value)


def test_an_environment_is_made_of_a_folder_of_wheels_tested_and_marked_ready(place):
    assert done(place.from_folder()).startswith("The backend is ready: torch 0-tiny on fake device")
    state, about = state_of(place.folder)
    assert state == "ready"
    assert (about["packages"], about["compute"], about["device"]) == (2, "cpu", "fake device")
    assert about["bytes"] == 2000
    assert not place.folder.downloads.exists()
    assert not place.folder.temporary.exists()
    assert next(candidates(None, place.folder.environment))[1] == place.folder.python


@pytest.mark.slow
def test_an_environment_may_have_a_pip_of_its_own(place, monkeypatch):
    monkeypatch.setattr(setup, "_VENV", setup._VENV[:-1])
    monkeypatch.setattr(setup, "_pip", lambda python: [str(python), "-I", "-m", "pip"])
    assert done(place.from_folder())
    assert list(place.folder.environment.rglob("pip-*.dist-info"))


@pytest.mark.parametrize("name", ["environment", "downloads", "temporary"])
def test_what_a_link_leads_to_is_not_emptied(place, tmp_path, name):
    own = tmp_path / "own" / MARK
    write_atomically(own, "mine")
    link = getattr(place.folder, name)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(own.parent, target_is_directory=True)
    assert failed(place.from_folder()).endswith(
        "is a link to another folder: remove the link, then set the backend up again"
    )
    assert own.read_text() == "mine"


def test_setting_up_again_mends_a_damaged_environment(place):
    done(place.from_folder())
    module = next(place.folder.environment.rglob("tiny.py"))
    good = module.read_bytes()
    module.write_text("PROBLEM = None  # and more")
    done(place.from_folder())
    assert next(place.folder.environment.rglob("tiny.py")).read_bytes() == good


def test_a_wheel_that_is_not_the_locked_one_is_not_installed(place, monkeypatch):
    write_wheel(place.wheels, "torch", "__version__ = 'evil'\n")
    assert "hash differs" in failed(place.from_folder())
    with served(place.wheels) as (index, _):
        own_index(monkeypatch, index)
        assert "torch is not the right one (its hash differs)" in failed(place.from_index())
    assert state_of(place.folder)[0] == "broken"
    assert not list(place.folder.environment.rglob("torch.py"))


def test_pip_gets_the_lock_as_it_was_checked(place):
    steps = place.from_folder()
    place.lock.write_text("--index-url http://localhost:9/\nevil==1\n")
    assert done(steps).startswith("The backend is ready")
    place.lock.write_text("--index-url http://localhost:9/\nevil==1\n")
    with refused(ValueError, "line 1 of"):
        read_lock(place.lock)


def test_a_web_page_among_the_wheels_is_named_before_anything_is_made(place):
    (place.wheels / "links.HTM").write_text('<a href="http://localhost:9/torch-9-py3-none-any.whl">')
    assert "links.HTM is a web page" in failed(place.from_folder())
    assert not place.folder.root.exists()


def test_a_folder_in_place_of_a_wheel_is_named_before_anything_is_made(place):
    (place.wheels / "idna-3.10-py3-none-any.whl").mkdir()
    with refused(IsADirectoryError, "idna-3.10"):
        done(place.from_folder())
    assert not place.folder.root.exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_a_pipe_among_the_wheels_is_named_before_anything_is_made(place):
    os.mkfifo(place.wheels / "torch-9-py3-none-any.whl")
    with refused(PermissionError, "torch-9"):
        done(place.from_folder())
    assert not place.folder.root.exists()


def test_a_wheel_that_is_missing_in_the_folder_is_named(place):
    next(place.wheels.glob("torch-*")).unlink()
    assert failed(place.from_folder()).startswith("there is no torch")


def test_a_cancel_ends_pip_at_once_and_the_next_try_fetches_only_what_is_missing(place, monkeypatch):
    others = set(psutil.Process().children())
    with served(place.wheels, stalls="torch") as (index, handler):
        own_index(monkeypatch, index)
        steps = place.from_index()
        until(lambda: next(steps) and any(path.startswith("/torch-") for path in handler.asked))
        processes = set(psutil.Process().children()) - others
        assert processes
        steps.close()
        until(lambda: not any(_alive(process) for process in processes), 5.0)
        assert state_of(place.folder)[0] == "broken"
        handler.stalls = ""
        handler.asked.clear()
        done(place.from_index())
        assert [path for path in handler.asked if path.endswith(".whl")] == ["/torch-1.0-py3-none-any.whl"]
    assert state_of(place.folder)[0] == "ready"


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_an_environment_whose_blender_or_mark_is_gone_is_not_used(place, tmp_path):
    done(place.from_folder())
    mark = place.folder.environment / MARK
    mark.write_text(json.dumps({**json.loads(mark.read_text()), "base": str(tmp_path / "old blender/python")}))
    assert state_of(place.folder)[0] == "broken"
    mark.unlink()
    assert state_of(place.folder)[0] == "broken"
    assert [source for source, _ in candidates(None, place.folder.environment)] == ["Blender's own Python"]


def test_an_environment_that_fails_its_self_test_is_not_ready(place):
    write_lock(place.lock, write_packages(place.wheels, problem="the graphics card is on fire"))
    assert failed(place.from_folder()) == "the self-test failed: the graphics card is on fire"
    assert state_of(place.folder)[0] == "broken"


@pytest.mark.slow
def test_the_self_test_compiles_what_the_first_press_needs(tmp_path, monkeypatch):
    monkeypatch.setenv("PRIMDIFFUSION_DEVICE", "cpu")
    cache = tmp_path / "cache"
    run_to_end(setup._trial(PYTHON, BACKEND, cache, tmp_path))
    compiled = sorted(cache.rglob("*.nbc"))
    assert compiled
    backend = Backend(lambda: _client(cache))
    request = ChildRequest(
        backend, "generate", {"seed": 1, "steps": 3, "picture_px": 64, "out_dir": str(tmp_path / "out")}
    )
    until(lambda: request.tick() is None or request.finished)
    backend.release()
    assert request.error is None
    assert sorted(cache.rglob("*.nbc")) == compiled


def _client(cache: Path) -> BackendClient:
    return BackendClient(PYTHON, BACKEND, cache_dir=cache)


def test_no_network_is_a_sentence(place, monkeypatch):
    own_index(monkeypatch)
    assert failed(place.from_index()).startswith("the package index cannot be reached")


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
def test_a_python_that_cannot_make_an_environment_is_named(place, tmp_path, monkeypatch):
    host = tmp_path / "host"
    host.write_text('#!/bin/sh\necho "No module named venv"\nexit 1\n')
    host.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(host))
    message = failed(place.from_folder())
    assert str(host) in message
    assert "python3-venv" in message
    assert state_of(place.folder)[0] == "absent"
    assert "No module named venv" in place.folder.log.read_text()


def test_a_damaged_list_of_packages_is_an_error_before_anything_is_made(place):
    place.lock.write_text("torch\n")
    with refused(ValueError, "line 1"):
        place.from_folder()
    assert not place.folder.environment.exists()


def test_a_very_long_path_holds_an_environment(place, tmp_path):
    if os.name == "nt":
        pytest.skip("there the environment goes to a short folder instead")
    root = tmp_path.joinpath(*["sehr lange"] * 24)
    assert len(str(root)) > 260
    assert done(place._replace(folder=SetUpFolder(root)).from_folder())
