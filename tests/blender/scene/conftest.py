"""A human with files on the disk."""

from __future__ import annotations

import bpy
import pytest
import synthetic_shape
from exporting import write_person
from human_stage import COUNT, build_posed


@pytest.fixture
def source(addon, tmp_path, monkeypatch):
    folder = tmp_path / "source"
    folder.mkdir()
    npz = synthetic_shape.write(folder / "human.npz", COUNT)
    monkeypatch.setenv("FAKE_HUMAN", str(npz))
    write_person(folder / "person.human.safetensors", synthetic_shape.arrays(COUNT)["betas"])
    return folder


@pytest.fixture
def person(source):
    anna = build_posed(source)
    bpy.ops.wm.save_mainfile()
    return anna
