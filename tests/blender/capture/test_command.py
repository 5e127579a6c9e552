"""The command `capture` says how long it will take, and asks a user at a terminal."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.camera_rig import Rig
from support.errors import refused

from blender_primdiffusion.capture import command
from blender_primdiffusion.capture.command import parse, settings_of
from blender_primdiffusion.capture.settings import CaptureSettings
from blender_primdiffusion.console import CANCELLED, DONE

pytestmark = pytest.mark.any_blender


class Terminal(io.StringIO):
    """A user who has typed one line."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def words(tmp_path, monkeypatch) -> list[str]:
    """A run of 720 views of one scan, which renders nothing."""
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "anna.glb").touch()
    monkeypatch.setattr(command, "_render", lambda *_: DONE)
    return ["--people", str(tmp_path / "scans"), "--out", str(tmp_path / "captures")]


def typed(monkeypatch, line: str, words: list[str]) -> int:
    monkeypatch.setattr("sys.stdin", Terminal(line))
    return command.main(words)


def test_720_views_are_rendered_only_after_a_yes(words, monkeypatch, capfd):
    assert typed(monkeypatch, "\n", words) == CANCELLED
    said = capfd.readouterr().out
    assert "720 views (1 person x 20 poses x 36 cameras) take about 26 min 24 s on two processor cores" in said
    assert "Render them? [y/N]" in said
    assert typed(monkeypatch, "n\n", words) == CANCELLED
    assert typed(monkeypatch, "y\n", words) == DONE


@pytest.mark.parametrize("more", [["--yes"], ["--poses", "2"], ["--list"], ["--progress", "json"]])
def test_scripts_short_runs_and_other_programs_are_not_asked(words, more, monkeypatch, capfd):
    assert typed(monkeypatch, "", [*words, *more]) == DONE
    assert "[y/N]" not in capfd.readouterr().out


def test_without_a_terminal_the_estimate_is_printed(words, monkeypatch, capfd):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert command.main(words) == DONE
    assert "720 views" in capfd.readouterr().out


def test_the_estimate_grows_with_pixels_and_samples_and_counts_the_shards_own_people(tmp_path):
    options = ["--out", str(tmp_path), "--poses", "1", "--cameras", "10", "--shard", "1/2"]
    views, _ = command.estimate(settings_of(parse(options)), 5)
    assert views == 2 * 10
    _, sentence = command.estimate(settings_of(parse([*options, "--size", "1024", "1024", "--samples", "32"])), 5)
    assert "2 people" in sentence
    assert f"{2.2 * 20 * 4 * 2 // 60:.0f} min" in sentence


def test_options_left_out_are_the_defaults_of_the_settings(tmp_path):
    assert settings_of(parse(["--out", str(tmp_path)])) == CaptureSettings(tmp_path)


def test_each_option_reaches_its_setting(tmp_path):
    words = "--poses 3 --cameras 5 --fov 20 --margin 2 --samples 7 --together 2 --light dome --shadows --float-depth"
    settings = settings_of(parse(["--out", str(tmp_path), *words.split(), "--elevations", "-5", "5", "--denoise"]))
    rig = Rig(count=5, vertical_fov=20.0, margin=2.0, elevations=(-5.0, 5.0))
    assert settings == CaptureSettings(
        tmp_path, rig=rig, pose_count=3, samples=7, together=2, light="dome", shadows=True, float_depth=True,
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
