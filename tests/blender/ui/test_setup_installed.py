"""The installed zip sets up its backend for real, with torch, and generates with it; slow, and needs an index."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import build_addon

LOCK = build_addon.ADDON / "requirements" / "linux_x86_64-py311-cpu.txt"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(sys.platform != "linux" or sys.version_info[:2] != (3, 11), reason="made for this lock"),
]


def report_of(archive: Path, user: Path, **pip: str) -> dict:
    """What the program says that installs, sets up, generates and repairs."""
    user.mkdir()
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user), **pip}
    program = Path(__file__).parents[1] / "installed_set_up.py"
    command = [sys.executable, str(program), str(archive)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=1700, cwd=user)
    reports = [line for line in done.stdout.splitlines() if line.startswith("REPORT ")]
    assert reports, done.stdout[-3000:] + done.stderr[-3000:]
    print(reports[0])
    return json.loads(reports[0].removeprefix("REPORT "))


def check(report: dict, user: Path) -> None:
    assert report["before"] == "absent"
    assert report["outcome"] == ["FINISHED"]
    assert report["after"] == "ready"
    assert report["about"]["torch"].startswith("2.13.0")
    assert report["about"]["packages"] == LOCK.read_text().count("--hash=")
    assert report["root"] == str(user / "extensions/.user/user_default/primdiffusion")
    assert report["repaired"] == ["FINISHED"]
    assert report["at_last"] == "ready"
    assert report["generated"] == ["FINISHED"]
    assert report["bones"] == [24]


def test_the_installed_zip_sets_up_its_backend_and_generates_with_it(tmp_path):
    check(report_of(build_addon.build(tmp_path), tmp_path / "user"), tmp_path / "user")


def test_a_folder_that_pip_has_filled_is_enough_without_a_network(tmp_path):
    download = ["download", "--require-hashes", "--only-binary", ":all:", "--no-deps", "-r", str(LOCK)]
    subprocess.run([sys.executable, "-m", "pip", *download, "-d", str(tmp_path / "wheels")], check=True)
    offline = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(tmp_path / "wheels")}
    check(report_of(build_addon.build(tmp_path), tmp_path / "user", **offline), tmp_path / "user")
