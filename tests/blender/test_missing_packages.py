"""A Blender without numpy and openvdb, as Debian packages it: the extension says so, and its command line generates."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest
from support.errors import refused

from blender_primdiffusion import places
from blender_primdiffusion.console import DONE, UNUSABLE
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.ui.setup import known, preferences

pytestmark = pytest.mark.any_blender

ROOT = Path(__file__).parents[2]
CHILD = """
import sys
from pathlib import Path
import bpy, numpy  # numpy first, or it could not be hidden
root, out = Path(sys.argv[1]), sys.argv[2]
for name in [name for name in sys.modules if name.partition(".")[0] in ("numpy", "openvdb")] + ["openvdb"]:
    sys.modules[name] = None  # importing it fails
sys.path.insert(0, str(root / "tests" / "blender"))
import blender_primdiffusion
import pytest
from backend_python import use_this_python
use_this_python(pytest.MonkeyPatch(), root / "tests" / "support" / "child")
blender_primdiffusion.register()
from blender_primdiffusion.ui.batch import execute
words = ["generate", "--out", out, "--steps", "1", "--pictures", "16"]
try:
    bpy.ops.primdiffusion.generate(seed=7, steps=1)
    operator = "generated in vain"
except RuntimeError as error:
    operator = str(error)
codes = [execute([*words, "--seed", "7"]), execute([*words, "--seed", "8", "--blend"]), execute(["render", out])]
import json
print("REPORT", json.dumps({"codes": codes, "operator": operator}))
"""


@pytest.fixture(scope="module")
def debian(tmp_path_factory) -> tuple[dict, str, Path]:
    """What a Blender without both packages reports, what it prints as errors, and the folder for people."""
    out = tmp_path_factory.mktemp("debian") / "people"
    prepared = ROOT / "tests" / "blender" / "test_missing_packages.py"  # the fake child copies any file
    command = [sys.executable, "-c", CHILD, str(ROOT), str(out)]
    environment = {**os.environ, "FAKE_HUMAN": str(prepared)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    line = next((line for line in done.stdout.splitlines() if line.startswith("REPORT ")), None)
    assert line is not None, done.stdout + done.stderr
    return json.loads(line.removeprefix("REPORT ")), done.stderr, out


def test_enabling_names_the_packages_and_debians(debian):
    _, said, _ = debian
    assert "the Python of this Blender lacks numpy and openvdb" in said
    assert "sudo apt install python3-numpy python3-openvdb" in said


def test_the_command_line_still_generates_people(debian):
    report, _, out = debian
    assert report["codes"][0] == DONE
    assert (out / "person_000007" / "person.human.safetensors").is_file()


def test_what_needs_the_packages_is_rejected_before_anything_is_generated(debian):
    report, said, out = debian
    assert report["codes"][1:] == [UNUSABLE, UNUSABLE]
    assert "--blend: the Python of this Blender lacks" in said
    assert not (out / "person_000008").exists()
    assert "python3-openvdb" in report["operator"]


@pytest.fixture
def without_openvdb(addon, monkeypatch):
    """A Blender that has numpy alone."""
    find_spec = places.importlib.util.find_spec
    monkeypatch.setattr(places.importlib.util, "find_spec", lambda name: find_spec(name) if name != "openvdb" else None)
    places.missing_packages.cache_clear()
    yield
    places.missing_packages.cache_clear()


def test_without_openvdb_alone_no_request_reaches_the_child(without_openvdb):
    with refused(RuntimeError, "python3-openvdb"):
        bpy.ops.primdiffusion.generate(seed=7, steps=1)
    assert queue.last is None or queue.last.entry.job.label != "Human, seed 7"
    assert queue.child_pid is None


def test_the_panel_names_the_package_and_offers_no_set_up(without_openvdb):
    from unittest.mock import MagicMock

    assert known.known().state == "lacking"
    layout = MagicMock()
    assert not preferences.draw_set_up(layout)
    assert not layout.box().operator.called
    with refused(RuntimeError, "openvdb"):
        bpy.ops.primdiffusion.test_backend()


def test_a_blender_with_both_packages_lacks_nothing(addon):
    places.missing_packages.cache_clear()
    assert places.missing_packages() == ""
