"""The command `capture` reads its options as the panel does its settings."""

import json

import numpy as np
import pytest
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.camera_rig import Rig
from support.errors import refused

from blender_primdiffusion.capture.command import parse, settings_of
from blender_primdiffusion.capture.settings import CaptureSettings

pytestmark = pytest.mark.any_blender


def test_options_left_out_are_the_defaults_of_the_settings(tmp_path):
    assert settings_of(parse(["--out", str(tmp_path)])) == CaptureSettings(tmp_path)


def test_each_option_reaches_its_setting(tmp_path):
    words = "--poses 3 --cameras 5 --fov 20 --margin 2 --samples 7 --together 2 --light dome --float-depth"
    settings = settings_of(parse(["--out", str(tmp_path), *words.split(), "--elevations", "-5", "5", "--denoise"]))
    rig = Rig(count=5, vertical_fov=20.0, margin=2.0, elevations=(-5.0, 5.0))
    assert settings == CaptureSettings(
        tmp_path, rig=rig, pose_count=3, samples=7, together=2, light="dome", float_depth=True,
        denoise=True,
    )  # fmt: skip


def test_a_camera_file_with_a_reflection_is_refused_and_its_camera_named(tmp_path):
    path = tmp_path / "cameras.json"
    cameras = {f"camera000{i}": {"K": np.eye(3).tolist(), "R": np.eye(3).tolist(), "T": [0, 0, 3]} for i in range(2)}
    cameras["camera0001"]["R"] = np.diag([-1.0, 1, 1]).tolist()
    path.write_text(json.dumps(cameras))
    with refused(FileError, str(path), "camera0001", "rotation"):
        settings_of(parse(["--out", str(tmp_path), "--camera-file", str(path)]))


@pytest.mark.parametrize("seed", ["-1", str(2**63)])
def test_a_seed_out_of_range_is_named(tmp_path, seed):
    with refused(ValueError, str(seed)):
        settings_of(parse(["--out", str(tmp_path), f"--seed={seed}"]))
