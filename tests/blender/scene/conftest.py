"""A human with files on the disk."""

import bpy
import pytest
import synthetic_shape
from human_stage import COUNT, build_posed


@pytest.fixture
def source(addon, tmp_path, monkeypatch):
    folder = tmp_path / "source"
    folder.mkdir()
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(folder, COUNT)))
    return folder


@pytest.fixture
def content(source):
    """The bytes of the human's file, and of its body's."""
    return tuple((source / name).read_bytes() for name in ("person.human.safetensors", "body.safetensors"))


@pytest.fixture
def person(source):
    anna = build_posed(source)
    bpy.ops.wm.save_mainfile()
    return anna
