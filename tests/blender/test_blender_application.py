"""The extension in Blender itself, as users have it: the zip installed by its command line, commands, scripts, removal.

The environment variable BLENDER names the program, else it is looked for on PATH. Where it cannot see the system's
temporary folder (a snap, a chroot), give pytest a --basetemp that it can.
"""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import build_addon
from blender_primdiffusion.console import DONE, UNUSABLE

BLENDER = os.environ.get("BLENDER") or shutil.which("blender")
MODULE = "bl_ext.user_default.primdiffusion"
ROOT = Path(__file__).resolve().parents[2]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BLENDER is None, reason="no Blender: put it on PATH, or name it: BLENDER=/path/to/blender"),
]

Run = Callable[..., subprocess.CompletedProcess]


@pytest.fixture(scope="module")
def resources(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("user")


@pytest.fixture(scope="module")
def bare(resources) -> Run:
    """Blender with words; it knows no Python for the backend."""

    def run(*words: object, **more: str) -> subprocess.CompletedProcess:
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(resources), **more}
        if "PRIMDIFFUSION_PYTHON" not in more:
            environment.pop("PRIMDIFFUSION_PYTHON", None)
        command = [str(BLENDER), *map(str, words)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=500, check=False)

    return run


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    return build_addon.build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def installed(bare, archive) -> Run:
    """Blender with the extension; its console must hold no error of ours."""
    done = bare("--command", "extension", "install-file", "-r", "user_default", "--enable", archive)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Installed" in done.stdout
    assert not _complaints(done)
    return bare


@pytest.fixture(scope="module")
def command(installed) -> Run:
    """`blender -c primdiffusion ...` with a Python that runs the backend, named by the environment."""
    import engine_stage

    return lambda *words: installed("-c", "primdiffusion", *words, PRIMDIFFUSION_PYTHON=str(engine_stage.PYTHON))


def _complaints(done: subprocess.CompletedProcess) -> list[str]:
    lines = (done.stdout + done.stderr).splitlines()
    return [line for line in lines if "Traceback" in line or "Error" in line or "rror:" in line]


def test_blender_validates_the_zip_and_rejects_a_spoiled_one(bare, archive, tmp_path):
    assert bare("--command", "extension", "validate", archive).returncode == 0
    (tmp_path / "spoiled.zip").write_bytes(archive.read_bytes()[:1000])
    assert bare("--command", "extension", "validate", tmp_path / "spoiled.zip").returncode != 0


def test_a_rigged_mesh_is_captured(command, tmp_path, empty_scene):
    import scan_fixtures

    from blender_primdiffusion.capture.body import read_body

    scan_fixtures.person(read_body(None), np.zeros(10))
    scan_fixtures.save(tmp_path / "scans" / "anna.glb")
    out = tmp_path / "captures"
    cheap = ["--cameras", 2, "--poses", 1, "--size", 48, 64, "--samples", 1]
    done = command("capture", "--people", tmp_path / "scans", "--out", out, *cheap)
    assert done.returncode == DONE, done.stdout + done.stderr
    pictures = [path for path in out.rglob("*.png") if "img" in str(path) or "camera" in str(path)]
    assert pictures
    assert (out / "anna" / "complete.json").is_file()
    (tmp_path / "file").write_text("")
    done = command("capture", "--people", tmp_path / "scans", "--out", tmp_path / "file" / "captures", *cheap)
    assert done.returncode == UNUSABLE
    assert "nothing can be written to" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["nonsense"],
        ["capture", "--people", "/nowhere", "--out", "x"],
    ],
)
def test_wrong_words_end_with_their_exit_code_and_a_sentence(installed, words):
    done = installed("-c", "primdiffusion", *words)
    assert done.returncode == UNUSABLE
    assert "Traceback" not in done.stdout + done.stderr
    assert done.stderr.strip()


def test_a_script_runs_the_operators_and_a_failing_one_ends_with_its_exit_code(installed, tmp_path):
    import engine_stage

    python = str(engine_stage.PYTHON)
    script = ROOT / "examples" / "blender_batch.py"
    words = ["-b", "--python-exit-code", 9, "--python", script, "--"]
    words += ["--out", tmp_path, "--steps", 3, "--frames", 1, "--size", 64, 64]
    done = installed(*words, PRIMDIFFUSION_PYTHON=python)
    assert done.returncode == 0, done.stdout + done.stderr
    assert _pixels(tmp_path / "0001.png").any()
    checkpoint = f"bpy.context.preferences.addons[{MODULE!r}].preferences.checkpoint = '/nowhere'"
    failing = f"import bpy; {checkpoint}; bpy.ops.primdiffusion.generate()"
    done = installed("-b", "--python-exit-code", 9, "--python-expr", failing, PRIMDIFFUSION_PYTHON=python)
    assert done.returncode == 9
    assert "/nowhere" in done.stdout + done.stderr


def test_it_is_disabled_and_enabled_again_without_a_trace(installed, tmp_path):
    program = Path(__file__).parent / "application_life.py"
    done = installed("-b", "--python-exit-code", 9, "--python", program, "--", tmp_path / "life.json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert not _complaints(done)
    life = json.loads((tmp_path / "life.json").read_text())
    assert life["left"] == []
    assert not life["numpy"]


def test_uninstalling_takes_the_extension_its_folder_and_its_backend_away(installed, resources, archive):
    own = resources / "extensions" / ".user" / "user_default" / "primdiffusion"
    (own / "env").mkdir(parents=True, exist_ok=True)
    (own / "env" / "file").write_text("")
    try:
        done = installed("--command", "extension", "remove", "primdiffusion")
        assert done.returncode == 0, done.stdout + done.stderr
        assert not own.exists()
        assert not (resources / "extensions" / "user_default" / "primdiffusion").exists()
        listed = "import bpy; print('ENABLED', [a.module for a in bpy.context.preferences.addons])"
        assert MODULE not in installed("-b", "--python-expr", listed).stdout
    finally:
        installed("--command", "extension", "install-file", "-r", "user_default", "--enable", archive)


def _pixels(path: Path) -> np.ndarray:
    """RGB over black."""
    pillow = pytest.importorskip("PIL.Image")
    picture = np.asarray(pillow.open(path).convert("RGBA")) / 255.0
    return picture[..., :3] * picture[..., 3:]
