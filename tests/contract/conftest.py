"""The real child and the real client, without Blender: the extension's package `backend` is loaded by itself."""

import sys
from pathlib import Path

import pytest
from tiny_model import save_tiny_checkpoint

sys.path.insert(0, str(Path(__file__).parents[2] / "blender_primdiffusion"))


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    return save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors")
