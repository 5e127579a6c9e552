"""Which packages suit a machine, and where they go; the locks that are shipped."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from support.errors import refused

from blender_primdiffusion.backend.environment import LONGEST_INSIDE, WINDOWS_LONGEST, short_root
from blender_primdiffusion.backend.packages import (
    Machine,
    chosen_compute,
    locks_for,
    read_lock,
    this_machine,
)

ROOT = Path(__file__).parents[2]
LOCKS = ROOT / "blender_primdiffusion" / "requirements"
LINUX = Machine("linux_x86_64", (3, 11), None, False, None)
CARD = Machine("linux_x86_64", (3, 11), None, True, 580)
BOTH = ("cpu", "cuda")


@pytest.mark.parametrize(
    ("machine", "wish", "chosen", "note"),
    [
        (LINUX, "automatic", "cpu", ""),
        (CARD, "automatic", "cuda", ""),
        (CARD, "cpu", "cpu", ""),
        (Machine("linux_x86_64", (3, 11), None, True, 535), "automatic", "cpu", "driver 535 is too old"),
        (Machine("windows_x86_64", (3, 11), None, True, None), "automatic", "cuda", ""),
        (LINUX, "cuda", "cuda", "No NVIDIA driver was found"),
    ],
)
def test_what_is_computed_on_follows_the_machine_and_the_wish(machine, wish, chosen, note):
    compute, message = chosen_compute(machine, wish, BOTH)
    assert compute == chosen
    assert note in message


def test_an_nvidia_card_without_locked_packages_falls_back_and_says_so():
    assert chosen_compute(CARD, "automatic", ["cpu"])[0] == "cpu"
    assert "see the manual" in chosen_compute(CARD, "automatic", ["cpu"])[1]


def test_an_apple_computer_takes_its_own_packages():
    machine = Machine("macos_arm64", (3, 13), 15, False, None)
    assert chosen_compute(machine, "automatic", ["apple"]) == ("apple", "")


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
    with pytest.raises(ValueError, match=message):
        chosen_compute(machine, wish, available)


def test_this_machine_is_described_without_starting_anything():
    assert re.fullmatch(r"[\w ]+(, NVIDIA driver[ \d]*)?, Python 3\.\d+", this_machine().described)


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
    ],
)
def test_only_whole_lines_of_a_requirement_or_an_index_are_read(tmp_path, line):
    path = tmp_path / "requirements.txt"
    path.write_text(f"idna==3.10 {HASH}\n{line}\n")
    with refused(ValueError, "line 2", str(path)):
        read_lock(path)


def test_a_second_index_is_refused(tmp_path):
    path = tmp_path / "requirements.txt"
    path.write_text(f"--extra-index-url https://x\n--extra-index-url https://y/whl/cpu\nidna==3.10 {HASH}\n")
    with refused(ValueError, "line 2", "https://y/whl/cpu"):
        read_lock(path)


def test_pip_gets_no_line_that_was_not_read(tmp_path):
    path = tmp_path / "requirements.txt"
    index, one = "--extra-index-url https://x:8080/whl/cu130", f"idna==3.10+cpu.1 {HASH} {HASH}"
    hidden = "# coding: utf-7\n#+AAo--r https://y/more.txt"
    path.write_text(f"{hidden}\n{index}\n\n{one}  # 5 bytes, ? installed\n")
    assert read_lock(path).requirements == f"{index}\n{one}\n"
