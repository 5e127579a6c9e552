"""The real child and the real client, without Blender."""

from pathlib import Path

import pytest
from tiny_model import save_tiny_checkpoint


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    return save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors")
