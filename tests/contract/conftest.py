"""The real child and the real client, without Blender."""

from pathlib import Path

import pytest
from tiny_model import SLOW, save_tiny_checkpoint


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    return save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors")


@pytest.fixture(scope="session")
def slow_checkpoint(tmp_path_factory) -> Path:
    """The same people, in steps that take long enough to interrupt `BUSY_STEPS` of them on any machine."""
    return save_tiny_checkpoint(tmp_path_factory.mktemp("slow_checkpoint") / "slow.safetensors", SLOW)
