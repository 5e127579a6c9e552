"""A full disk is reported in a sentence before anything is installed (scripts/enough_room.sh)."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "enough_room.sh"


@pytest.fixture
def ask(tmp_path, monkeypatch):
    """The script on disks of which `df` tells what is free, in megabytes."""

    def ask(*words: str, here: int, there: int | None = None) -> subprocess.CompletedProcess:
        program = tmp_path / "bin" / "df"
        program.parent.mkdir(exist_ok=True)
        other = f"case $2 in .) disk=a free={here};; *) disk=b free={there};; esac"
        one = f"disk=a free={here}"
        program.write_text(
            f"#!/bin/sh\n{one if there is None else other}\necho Filesystem\necho $disk 1 1 $free 1% /\n"
        )
        program.chmod(0o755)
        environment = {**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}", "TMPDIR": str(tmp_path)}
        command = ["sh", str(SCRIPT), *words]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    return ask


def test_what_is_free_and_what_is_needed_is_one_sentence(ask, tmp_path):
    done = ask(".venv:3700", ".venv45:1000", here=900)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"0.9 GB are free on the disk of {tmp_path}, and 6.2 GB are needed" in done.stderr
    assert ask(".venv:3700", ".venv45:1000", here=6300).returncode == 0


def test_what_is_installed_is_not_asked_for_again(ask, tmp_path):
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / "ready").touch()
    assert ask(".venv:3700", here=1).returncode == 0
    assert ask(".venv:3700", ".venv45:1000", here=2000).returncode == 1


def test_pips_temporary_folder_on_another_disk_counts_by_itself(ask, tmp_path):
    assert ask(".venv:3700", here=3800, there=1600).returncode == 0
    done = ask(".venv:3700", here=9000, there=100)
    assert done.returncode == 1
    assert f"0.1 GB are free on the disk of {tmp_path}, and 1.5 GB are needed" in done.stderr
    assert "TMPDIR" in done.stderr
