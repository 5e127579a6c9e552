"""The installed zip sets up its backend for real, with torch, and generates with it; slow, and needs an index."""

import subprocess
import sys
from pathlib import Path

import pytest
from own_blender import report_of

import build_addon

LOCK = build_addon.ADDON / "requirements" / "linux_x86_64-py311-cpu.txt"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(sys.platform != "linux" or sys.version_info[:2] != (3, 11), reason="made for this lock"),
]


def set_up(folder: Path, **pip: str) -> None:
    """Run the program that installs, sets up, generates and repairs, and check what it says."""
    report, _ = report_of("installed_set_up.py", build_addon.build(folder), folder=folder, seconds=1700, **pip)
    print(report)
    assert report["before"] == "absent"
    assert report["outcome"] == ["FINISHED"]
    assert report["after"] == "ready"
    assert report["about"]["torch"].startswith("2.13.0")
    assert report["about"]["packages"] == LOCK.read_text().count("--hash=")
    assert report["root"] == str(folder / "user" / "extensions/.user/user_default/primdiffusion")
    assert report["repaired"] == ["FINISHED"]
    assert report["at_last"] == "ready"
    assert report["generated"] == ["FINISHED"]
    assert report["bones"] == [24]


def test_the_installed_zip_sets_up_its_backend_and_generates_with_it(tmp_path):
    set_up(tmp_path)


def test_a_folder_that_pip_has_filled_is_enough_without_a_network(tmp_path):
    download = ["download", "--require-hashes", "--only-binary", ":all:", "--no-deps", "-r", str(LOCK)]
    subprocess.run([sys.executable, "-m", "pip", *download, "-d", str(tmp_path / "wheels")], check=True)
    offline = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(tmp_path / "wheels")}
    set_up(tmp_path, **offline)
