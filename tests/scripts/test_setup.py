"""The command that sets up the environments: what is missing is said before anything is installed."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from scripts import setup


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """An empty checkout in place of ours; the commands that would run are listed instead."""
    commands: list[list[str]] = []

    def run(command, **_):
        commands.append([str(word) for word in command])
        if "venv" in command:
            python = Path(setup.program(Path(command[-1])))
            python.parent.mkdir(parents=True)
            python.touch()

    monkeypatch.setattr(setup, "run", run)
    monkeypatch.setattr(setup, "ROOT", tmp_path)
    for name in ("VENV", "VENV52", "VENV53"):
        monkeypatch.setattr(setup, name, tmp_path / getattr(setup, name).name)
    sizes = {tmp_path / folder.name: size for folder, size in setup.MEGABYTES.items()}
    monkeypatch.setattr(setup, "MEGABYTES", sizes)
    monkeypatch.setattr(setup, "python311", lambda: "python3.11")
    monkeypatch.setattr(setup.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    for name in ("pyproject.toml", "requirements.lock", "requirements52.lock", "requirements53.lock"):
        (tmp_path / name).touch()
    return SimpleNamespace(folder=tmp_path, commands=commands)


@pytest.fixture
def disks(checkout, monkeypatch):
    """Set what is free on the disk of the checkout and on that of the temporary folder, MB; None: it is the same."""

    def free(here: int, there: int | None = None) -> None:
        temporary = checkout.folder / "temporary"
        temporary.mkdir(exist_ok=True)
        monkeypatch.setattr(setup, "temporary_folder", lambda: Path("/proc") if there is not None else temporary)
        monkeypatch.setattr(
            setup.shutil,
            "disk_usage",
            lambda folder: SimpleNamespace(free=(here if folder == setup.ROOT else there) * 2**20),
        )

    return free


def test_what_is_free_and_what_is_needed_is_one_sentence(checkout, disks):
    disks(900)
    with pytest.raises(setup.Stop) as raised:
        setup.check_room([setup.VENV, setup.VENV52])
    wanted = f"0.9 GB are free on the disk of {checkout.folder}, and 6.5 GB are needed"
    assert wanted in str(raised.value)
    disks(6600)
    setup.check_room([setup.VENV, setup.VENV52])


def test_all_tests_run_on_three_blenders_in_environments_that_are_made_once(checkout, disks, monkeypatch):
    disks(99_999)
    monkeypatch.setattr(setup, "python313", lambda: "python3.13")
    setup.test([])
    pythons = [setup.program(folder) for folder in (setup.VENV, setup.VENV52, setup.VENV53)]
    tests = [command[0] for command in checkout.commands if command[1:3] == ["-m", "pytest"]]
    assert tests == pythons
    installed = [command for command in checkout.commands if "install" in command]
    assert [command[0] for command in installed] == [pythons[0], pythons[0], *pythons[1:]]
    assert all("requirements.lock" in command for command in installed[:2])
    assert [command[0] for command in checkout.commands if "generate" in command] == [pythons[0]]  # compiles, once
    checkout.commands.clear()
    setup.test([])
    assert len(checkout.commands) == 3
    os.utime(setup.VENV / "ready", (1, 1))  # the lock is newer
    checkout.commands.clear()
    setup.test([])
    assert [command[0] for command in checkout.commands if "install" in command] == [pythons[0]] * 2


@pytest.mark.parametrize("red", [("5.0",), ("5.2",), ("5.0", "5.3"), ()])
def test_a_red_version_keeps_no_other_from_running_and_the_last_lines_say_which(
    checkout, disks, monkeypatch, capsys, red
):
    disks(99_999)
    monkeypatch.setattr(setup, "python313", lambda: "python3.13")
    versions = {"5.0": setup.VENV, "5.2": setup.VENV52, "5.3": setup.VENV53}
    failing, list_command = [setup.program(versions[name]) for name in red], setup.run

    def run(command, **variables):
        list_command(command, **variables)
        if command[1:3] == ["-m", "pytest"] and command[0] in failing:
            sys.exit(3)

    monkeypatch.setattr(setup, "run", run)
    monkeypatch.setattr(setup.sys, "argv", [])
    with pytest.raises(SystemExit) as ended:
        setup.main(["test"])
    assert ended.value.code == (1 if red else 0)
    tests = [command[0] for command in checkout.commands if command[1:3] == ["-m", "pytest"]]
    assert tests == [setup.program(folder) for folder in versions.values()]
    said = [f"Blender {name}: " + ("FAILED (exit code 3)" if name in red else "passed") for name in versions]
    assert capsys.readouterr().out.splitlines()[-3:] == said


def test_an_unknown_target_is_an_error_that_lists_all():
    command = [sys.executable, "-m", "scripts.setup", "tset"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 1
    assert all(name in done.stderr for name in ("tset", *setup.TARGETS))
