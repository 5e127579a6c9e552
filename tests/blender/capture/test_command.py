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


@pytest.mark.parametrize("words", ["--rm -rf", "--seed=-1", f"--seed={2**63}"])
def test_what_no_option_can_be_is_named(tmp_path, words):
    with refused(ValueError, words.split("=")[-1].split()[0]):
        settings_of(parse(["--out", str(tmp_path), *words.split()]))


EYE, REFLECTION, STRETCHED = (np.diag([x, 1.0, 1.0]).tolist() for x in (1, -1, 2))


@pytest.mark.parametrize(
    "cameras",
    [
        [],
        {},
        "no cameras",
        {"camera0000": {"K": 1}},
        *({"camera0000": {"K": EYE, "R": r, "T": [0, 0, 3]}} for r in (REFLECTION, STRETCHED)),
    ],
)
def test_a_file_whose_cameras_are_none_is_refused_and_the_camera_named(tmp_path, cameras):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(cameras))
    with refused(FileError, str(path), *(["camera0000"] if isinstance(cameras, dict) and cameras else [])):
        settings_of(parse(["--out", str(tmp_path), "--camera-file", str(path)]))
