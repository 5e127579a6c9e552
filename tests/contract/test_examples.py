"""The examples do what they say."""

import runpy
import subprocess
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("script", "options", "files"),
    [
        ("generate_pose_render.py", ["--size", "48"], {"yaw_000.png", "yaw_270.png", "person.human.safetensors"}),
        ("fit_boxes.py", ["--size", "32", "--steps", "4"], {"fit.png", "gradients.png", "linear_solve.png"}),
        ("drive_the_child.py", ["--steps", "2"], {"person.human.safetensors", "front.png"}),
    ],
)
def test_an_example_leaves_its_files(script, options, files, checkpoint, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, EXAMPLES / script, "--out", out, "--checkpoint", checkpoint, *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    assert files <= {path.name for path in out.iterdir()}


def test_the_page_is_served_to_this_machine_alone(checkpoint, monkeypatch):
    gradio = MagicMock()
    monkeypatch.setitem(sys.modules, "gradio", gradio)
    monkeypatch.setattr(sys, "argv", ["app.py", "--checkpoint", str(checkpoint)])
    runpy.run_path(str(EXAMPLES / "app.py"), run_name="__main__")
    page = gradio.Blocks.return_value.__enter__.return_value
    page.launch.assert_called_once_with(server_name="127.0.0.1", share=False)


def test_the_example_of_the_child_passes_its_sentence_on(tmp_path):
    command = [sys.executable, EXAMPLES / "drive_the_child.py", "--out", tmp_path / "out", "--checkpoint", "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 1
    assert "nowhere" in done.stderr.splitlines()[-1]
