"""Real Blenders on a real Ray cluster of two workers, one of which is killed on the way."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import bpy
import numpy as np
import psutil
import pytest
import scan_fixtures
from support.capture_files import faults

from blender_primdiffusion.capture.body import read_body
from blender_primdiffusion.formats import capture_layout

pytest.importorskip("ray", reason="Ray is not installed")
ROOT = Path(__file__).resolve().parents[3]
NAMES = ("anna", "bert", "carl")
SMALL = ("--poses", "2", "--cameras", "4", "--size", "96", "96", "--samples", "4", "--threads", "1")


@pytest.mark.slow
def test_a_killed_workers_person_is_finished_by_another_and_no_view_is_lost_or_doubled(empty_scene, tmp_path):
    body = read_body()
    for number, name in enumerate(NAMES):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scan_fixtures.person(body, np.full(10, 0.3 * number))
        scan_fixtures.save(tmp_path / "scans" / f"{name}.glb")
    out = tmp_path / "captures"
    renderer = [sys.executable, "-m", "blender_primdiffusion.capture", "--people", str(tmp_path / "scans")]
    farm = [sys.executable, "-m", "primdiffusion.cli", "captures", "farm", "--workers", "2", "--"]
    process = subprocess.Popen(
        [*farm, *renderer, "--out", str(out), *SMALL], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    written: dict[Path, int] = {}
    killed = None
    while process.poll() is None:
        for picture in out.glob("*/img/*/*.jpg"):
            written.setdefault(picture, picture.stat().st_ino)
        if killed is None and written:
            killed = next(iter(written)).parents[2].name
            blender = next(child for child in psutil.process_iter() if _renders(child, killed))
            os.kill(blender.ppid(), signal.SIGKILL)
        time.sleep(0.02)
    output = process.stdout.read()
    assert process.returncode == 0, output
    assert killed in NAMES
    assert sorted(line.split()[1] for line in output.splitlines() if "/3 " in line) == sorted(NAMES)
    assert not faults(out)
    assert len(list(out.glob("*/img/*/*.jpg"))) == 3 * 2 * 4
    assert all(path.stat().st_ino == inode for path, inode in written.items()), "a whole view was rendered again"
    assert (out / capture_layout.LIST_FILE).read_text().split() == list(NAMES)
    assert not list(out.rglob(".*partial*"))


def _renders(process: psutil.Process, name: str) -> bool:
    try:
        words = process.cmdline()
    except psutil.Error:
        return False
    return "blender_primdiffusion.capture" in words and words[-1] == name
