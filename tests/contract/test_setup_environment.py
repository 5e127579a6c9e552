"""The private environment: real venv, pip and hash checks on tiny wheels."""

import json
import os
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import psutil
import pytest
from blender_primdiffusion.files.whole_files import write_atomically
from packaging.requirements import Requirement
from support.errors import refused
from support.fake_child import FAKE_CHILD
from tiny_packages import own_index, served, until, with_this_pip, write_lock, write_packages, write_wheel
from waiting import BACKEND, PYTHON, run_to_end

from blender_primdiffusion.backend import setup
from blender_primdiffusion.backend.client import BackendClient
from blender_primdiffusion.backend.environment import (
    LONGEST_INSIDE,
    MARK,
    VARIABLE,
    WINDOWS_LONGEST,
    SetUpFolder,
    candidates,
    short_root,
    state_of,
)
from blender_primdiffusion.backend.packages import (
    Machine,
    chosen_compute,
    locks_for,
    read_lock,
)
from blender_primdiffusion.backend.requests import Backend, ChildRequest, Steps


class Place(NamedTuple):
    """What a set-up is made of."""

    folder: SetUpFolder
    wheels: Path
    lock: Path
    cache: Path

    def steps(self) -> Steps:
        return setup.set_up(self.folder, read_lock(self.lock), "cpu", FAKE_CHILD, self.cache)


@pytest.fixture
def place(tmp_path, monkeypatch) -> Iterator[Place]:
    """A folder with a space and an umlaut, and an index that serves one of wheels."""
    monkeypatch.delenv(VARIABLE, raising=False)
    with_this_pip(monkeypatch, setup)
    lock = write_lock(tmp_path / "lock.txt", write_packages(tmp_path / "räder"))
    root = tmp_path / "Menschen für Blender"
    with served(tmp_path / "räder") as (index, _):
        own_index(monkeypatch, index)
        yield Place(SetUpFolder(root), tmp_path / "räder", lock, root / "cache")


def done(steps: Steps) -> str:
    """How it ended."""
    return run_to_end(steps)


def failed(steps: Steps) -> str:
    """The sentence of a set-up that fails."""
    with pytest.raises(RuntimeError) as error:
        done(steps)
    return str(error.value)


def test_an_environment_is_made_tested_marked_ready_mended_and_left_where_its_blender_or_mark_is_gone(place, tmp_path):
    if os.name != "nt":  # there a very long path goes to a short folder instead
        root = tmp_path.joinpath(*["sehr lange"] * 24)
        assert len(str(root)) > 260
        place = place._replace(folder=SetUpFolder(root))
    assert done(place.steps()).startswith("The backend is ready: torch 0-tiny on fake device")
    state, about = state_of(place.folder)
    assert state == "ready"
    assert (about["packages"], about["compute"], about["device"]) == (2, "cpu", "fake device")
    assert about["bytes"] == 2000
    assert not place.folder.downloads.exists()
    assert not place.folder.temporary.exists()
    assert next(candidates(None, place.folder.environment))[1] == place.folder.python
    module = next(place.folder.environment.rglob("tiny.py"))
    good = module.read_bytes()
    module.write_text("PROBLEM = None  # and more")
    steps = place.steps()
    place.lock.write_text("--index-url http://localhost:9/\nevil==1\n")
    assert done(steps).startswith("The backend is ready"), "pip gets the lock as it was checked"
    assert next(place.folder.environment.rglob("tiny.py")).read_bytes() == good, "setting up again mends it"
    with refused(ValueError, "line 1 of"):
        read_lock(place.lock)
    mark = place.folder.environment / MARK
    mark.write_text(json.dumps({**json.loads(mark.read_text()), "base": str(tmp_path / "old blender/python")}))
    assert state_of(place.folder)[0] == "broken"
    mark.unlink()
    assert state_of(place.folder)[0] == "broken"
    assert [source for source, _ in candidates(None, place.folder.environment)] == ["Blender's own Python"]


@pytest.mark.slow
def test_an_environment_may_have_a_pip_of_its_own(place, monkeypatch):
    monkeypatch.setattr(setup, "_VENV", setup._VENV[:-1])
    monkeypatch.setattr(setup, "_pip", lambda python: [str(python), "-I", "-m", "pip"])
    assert done(place.steps())
    assert list(place.folder.environment.rglob("pip-*.dist-info"))


@pytest.mark.parametrize("name", ["environment", "downloads", "temporary"])
def test_what_a_link_leads_to_is_not_emptied(place, tmp_path, name):
    own = tmp_path / "own" / MARK
    write_atomically(own, "mine")
    link = getattr(place.folder, name)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(own.parent, target_is_directory=True)
    assert failed(place.steps()).endswith("is a link to another folder: remove the link, then set the backend up again")
    assert own.read_text() == "mine"


def test_wheels_that_are_missing_wrong_or_out_of_reach_are_named(place, monkeypatch):
    next(place.wheels.glob("torch-*")).unlink()
    assert failed(place.steps()).startswith("there is no torch")
    write_wheel(place.wheels, "torch", "__version__ = 'evil'\n")
    assert "torch is not the right one (its hash differs)" in failed(place.steps())
    assert state_of(place.folder)[0] == "broken"
    assert not list(place.folder.environment.rglob("torch.py"))
    own_index(monkeypatch)
    assert failed(place.steps()).startswith("the package index cannot be reached")


def test_a_cancel_ends_pip_at_once_and_the_next_try_fetches_only_what_is_missing(place, monkeypatch):
    others = set(psutil.Process().children())
    with served(place.wheels, stalls="torch") as (index, handler):
        own_index(monkeypatch, index)
        steps = place.steps()
        until(lambda: next(steps) and any(path.startswith("/torch-") for path in handler.asked))
        processes = set(psutil.Process().children()) - others
        assert processes
        steps.close()
        until(lambda: not any(_alive(process) for process in processes), 5.0)
        assert state_of(place.folder)[0] == "broken"
        handler.stalls = ""
        handler.asked.clear()
        done(place.steps())
        assert [path for path in handler.asked if path.endswith(".whl")] == ["/torch-1.0-py3-none-any.whl"]
    assert state_of(place.folder)[0] == "ready"


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_an_environment_that_fails_its_self_test_is_not_ready(place):
    write_lock(place.lock, write_packages(place.wheels, problem="the graphics card is on fire"))
    assert failed(place.steps()) == "the self-test failed: the graphics card is on fire"
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


@pytest.mark.skipif(os.name == "nt", reason="shell scripts")
def test_a_python_that_cannot_make_an_environment_is_named(place, tmp_path, monkeypatch):
    host = tmp_path / "host"
    host.write_text('#!/bin/sh\necho "No module named venv"\nexit 1\n')
    host.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(host))
    message = failed(place.steps())
    assert str(host) in message
    assert "python3-venv" in message
    assert state_of(place.folder)[0] == "absent"
    assert "No module named venv" in place.folder.log.read_text()


ROOT = Path(__file__).parents[2]
LOCKS = ROOT / "blender_primdiffusion" / "requirements"
LINUX = Machine("linux_x86_64", (3, 11), None, False, None)
CARD = Machine("linux_x86_64", (3, 11), None, True, 580)
BOTH = ("cpu", "cuda")


@pytest.mark.parametrize(
    ("machine", "wish", "available", "chosen", "note"),
    [
        (LINUX, "automatic", BOTH, "cpu", ""),
        (CARD, "automatic", BOTH, "cuda", ""),
        (CARD, "cpu", BOTH, "cpu", ""),
        (CARD, "automatic", ["cpu"], "cpu", "see the manual"),
        (Machine("linux_x86_64", (3, 11), None, True, 535), "automatic", BOTH, "cpu", "driver 535 is too old"),
        (Machine("windows_x86_64", (3, 11), None, True, None), "automatic", BOTH, "cuda", ""),
        (Machine("macos_arm64", (3, 13), 15, False, None), "automatic", ["apple"], "apple", ""),
        (LINUX, "cuda", BOTH, "cuda", "No NVIDIA driver was found"),
    ],
)
def test_what_is_computed_on_follows_the_machine_and_the_wish(machine, wish, available, chosen, note):
    compute, message = chosen_compute(machine, wish, available)
    assert compute == chosen
    assert note in message


@pytest.mark.parametrize(
    ("machine", "wish", "available", "message"),
    [
        (Machine("macos_arm64", (3, 11), 13, False, None), "automatic", ["apple"], "needs macOS 14 or newer"),
        (
            Machine("macos_x86_64", (3, 11), 14, False, None),
            "automatic",
            [],
            "no longer made for Macs with Intel",
        ),
        (Machine("windows_arm64", (3, 13), None, False, None), "automatic", [], "no packages for windows_arm64"),
        (LINUX, "apple", BOTH, "there are no packages for Apple Silicon here, but for CPU, NVIDIA"),
    ],
)
def test_what_cannot_be_is_rejected_in_a_sentence(machine, wish, available, message):
    with refused(ValueError, message):
        chosen_compute(machine, wish, available)


def test_the_environment_goes_to_a_short_folder_only_where_windows_needs_it():
    own = Path("C:/Users/Administrator/AppData/Roaming/Blender Foundation/Blender/5.0/extensions/.user/user_default")
    local = Path("C:/Users/Administrator/AppData/Local")
    assert short_root(own, None, "50") == own
    assert short_root(Path("D:/b"), local, "50") == Path("D:/b")
    short = short_root(own, local, "50")
    assert short == local / "primdiffusion" / "50"
    assert len(f"{short}/env/Lib/site-packages/") + LONGEST_INSIDE <= WINDOWS_LONGEST


BLENDERS = ((3, 11), (3, 13))
"""Pythons of Blender's own builds: 5.0, 5.1 and newer."""
OF_DISTRIBUTIONS = (3, 14)


@pytest.mark.parametrize(
    ("platform", "computes", "pythons"),
    [
        ("linux_x86_64", BOTH, (*BLENDERS, OF_DISTRIBUTIONS)),
        ("linux_arm64", ("cpu",), (*BLENDERS, OF_DISTRIBUTIONS)),
        ("windows_x86_64", BOTH, BLENDERS),
        ("macos_arm64", ("apple",), BLENDERS),
    ],
)
def test_every_platform_has_locks_of_the_projects_own_pins(platform, computes, pythons):
    for python in pythons:
        locks = locks_for(LOCKS, platform, python)
        assert set(locks) == set(computes)
        for path in locks.values():
            _holds_the_pins(path, _pins(platform, python))


def _pins(platform: str, python: tuple[int, int]) -> dict[str, str]:
    """Versions in requirements.lock of what pyproject.toml asks for there, but numpy's, which depends on the Python."""
    marked = {
        "platform_machine": "aarch64" if platform == "linux_arm64" else "x86_64",
        "python_version": ".".join(map(str, python)),
    }
    asked = map(Requirement, tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"])
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    locked = dict(line.split("==") for line in lines if not line.startswith("#"))
    wanted = [one.name for one in asked if one.marker is None or one.marker.evaluate(marked)]
    return {name: locked[name] for name in wanted if name != "numpy"}


def _holds_the_pins(path: Path, pins: dict[str, str]) -> None:
    lock = read_lock(path)
    versions = {package.name: package.version.split("+")[0] for package in lock.packages}
    assert {name: versions[name] for name in pins} == pins
    assert "numpy" in versions
    assert lock.download_bytes > 150e6
    assert lock.installed_bytes > lock.download_bytes
    assert all(package.bytes for package in lock.packages)
    own_builds = any("+" in package.version for package in lock.packages)
    assert ("--extra-index-url https://download.pytorch.org" in path.read_text()) == own_builds


def test_cpu_locks_hold_no_cuda_packages():
    for path in LOCKS.glob("*-cpu.txt"):
        assert not [package.name for package in read_lock(path).packages if package.name.startswith(("nvidia", "cuda"))]


@pytest.mark.parametrize("content", [b"\0" * 100, bytes(range(128, 256)) * 20, b"x" * 100_000, b"x" * 5_000_000])
def test_a_list_of_packages_that_is_none_is_one_short_sentence(tmp_path, content):
    path = tmp_path / "requirements.txt"
    path.write_bytes(content)
    with refused(ValueError, "requirements.txt") as caught:
        read_lock(path)
    assert len(str(caught.value)) < 200 + len(str(path))
    assert "\n" not in str(caught.value)


HASH = f"--hash=sha256:{'0' * 64}"


@pytest.mark.parametrize(
    "line",
    [
        "--extra-index-url https://x --no-binary :all:",
        "--extra-index-url https://x\\",
        "--extra-index-url http://x",
        "--extra-index-url file:///srv",
        "--extra-index-url https://${HOME}",
        "--extra-index-url https://x -r https://x/more.txt",
        "-r http://x/more.txt",
        "--find-links http://x",
        "-c /etc/passwd",
        f"-r==more.txt {HASH}",
        f"--no-binary==:all: {HASH}",
        f"torch==1.0;python_version>'3' {HASH}",
        f"torch==${{HOME}} {HASH}",
        f"torch==1.0 {HASH} --global-option=x",
        f"torch==1.0 {HASH} \\",
        f"./torch-1.0.tar.gz {HASH}",
        f"torch @ https://x/torch.whl {HASH}",
        "torch==1.0",
        "--extra-index-url https://x\n--extra-index-url https://y/whl/cpu",
    ],
)
def test_only_whole_lines_of_a_requirement_or_an_index_are_read(tmp_path, line):
    path = tmp_path / "requirements.txt"
    path.write_text(f"idna==3.10 {HASH}\n{line}\n")
    with refused(ValueError, "line 3" if "\n" in line else "line 2", str(path)):
        read_lock(path)


def test_pip_gets_no_line_that_was_not_read(tmp_path):
    path = tmp_path / "requirements.txt"
    index, one = "--extra-index-url https://x:8080/whl/cu130", f"idna==3.10+cpu.1 {HASH} {HASH}"
    hidden = "# coding: utf-7\n#+AAo--r https://y/more.txt"
    path.write_text(f"{hidden}\n{index}\n\n{one}  # 5 bytes, ? installed\n")
    assert read_lock(path).requirements == f"{index}\n{one}\n"
