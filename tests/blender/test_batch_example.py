"""The example of a script does what it says, and fails as a script should."""

import importlib.util
from pathlib import Path

import bpy
import numpy as np
import pytest
from engine_stage import pixels
from support.errors import refused
from support.fake_child import FAILS

from blender_primdiffusion.scene.human import humans

EXAMPLE = Path(__file__).parents[2] / "examples" / "blender_batch.py"
"""A seed that the fake child takes as an order."""


@pytest.fixture
def example():
    spec = importlib.util.spec_from_file_location("blender_batch", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def words(out: Path, **more: str) -> list[str]:
    given = {"out": str(out), "steps": "1", **more}
    return [
        "--frames",
        "2",
        "--size",
        "24",
        "16",
        *(word for name, value in given.items() for word in (f"--{name}", value)),
    ]


@pytest.mark.parametrize("motion", [pytest.param(None, marks=pytest.mark.any_blender), "still.npy"])
def test_it_generates_poses_moves_renders_and_saves(addon, tmp_path, example, motion):
    np.save(tmp_path / "still.npy", np.zeros((3, 72)))
    more = {"motion": str(tmp_path / motion)} if motion else {}
    out = tmp_path / "a{b}"
    example.main(words(out, **more))
    assert pixels(out / "0002.png").shape[:2] == (16, 24)
    bpy.ops.wm.open_mainfile(filepath=str(out / "people.blend"))
    first, second = sorted(humans(bpy.context.scene), key=lambda person: person.name)
    assert (first.name, second.name) == ("Person 7", "Person 8")
    assert first.pose.bones["right_shoulder"].rotation_quaternion.angle > 0.2
    assert first.animation_data is None
    assert second.animation_data.action.frame_range[1] >= 2
    assert second.location.x == pytest.approx(0.6)


@pytest.mark.any_blender
def test_a_failure_of_an_operator_ends_it(addon, tmp_path, example):
    with refused(RuntimeError, "checkpoint"):
        example.main([*words(tmp_path / "out"), "--seeds", "7", str(FAILS)])
