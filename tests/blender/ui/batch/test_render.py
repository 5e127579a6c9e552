"""Pictures from the command line: of .blend files, of people, of folders; whole, gone on with, named when they fail."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from engine_stage import pixels
from mathutils import Vector
from support.errors import refused

from blender_primdiffusion.backend.environment import BackendNotFound
from blender_primdiffusion.console import DONE, FAILED, NO_BACKEND, UNUSABLE
from blender_primdiffusion.scene.cycles import new_camera
from blender_primdiffusion.ui.batch import execute
from blender_primdiffusion.ui.batch.people import go_round, moving_extent
from blender_primdiffusion.ui.batch.render import draw

pytestmark = pytest.mark.any_blender

SMALL = ("--size", "24x16")


def render(source: Path, out: Path, *words: object) -> int:
    return execute(["render", str(source), "--out", str(out), *map(str, words)])


def report(out: Path) -> dict:
    return json.loads((out / "report.json").read_text())


def pictures(out: Path) -> list[str]:
    return sorted(str(path.relative_to(out)) for path in out.rglob("*.png"))


@pytest.fixture
def people(addon, tmp_path) -> Path:
    words = ["--out", str(tmp_path / "people"), "--seed", "7", "--count", "2", "--steps", "1", "--blend"]
    assert execute(["generate", *words]) == DONE
    return tmp_path / "people"


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "Bilder von überall"


def test_a_folder_of_people_becomes_a_picture_of_each(people, out):
    assert render(people, out, *SMALL, "--transparent") == DONE
    assert pictures(out) == ["person_000007.png", "person_000008.png"]
    assert pixels(out / "person_000007.png").shape == (16, 24, 4)
    assert report(out)["done"] == ["person_000007", "person_000008"]


def test_braces_in_a_folder_s_name_are_no_template(people, tmp_path):
    out = tmp_path / "a{b}" / "}{blend_name"
    assert render(people / "person_000007", out, *SMALL) == DONE
    assert pictures(out) == ["person_000007.png"]


@pytest.mark.unix
def test_a_picture_that_a_full_disk_cuts_off_is_not_kept(empty_scene, tmp_path):
    import resource

    scene = empty_scene.scene
    scene.camera = new_camera(scene)
    scene.render.engine, scene.render.resolution_x, scene.render.resolution_y = "CYCLES", 24, 16
    scene.cycles.samples = 1
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with refused(OSError, "disk full"):
            draw(scene, tmp_path / "a" / "b.png", tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list((tmp_path / "a").iterdir())


def test_existing_pictures_are_not_rendered_again(people, out):
    assert render(people / "person_000007", out, *SMALL) == DONE
    before = (out / "person_000007.png").stat().st_mtime_ns
    assert render(people, out, *SMALL) == DONE
    assert (out / "person_000007.png").stat().st_mtime_ns == before
    assert (report(out)["done"], report(out)["skipped"]) == (["person_000008"], ["person_000007"])
    assert render(people, out, "--size", "32x32") == UNUSABLE
    assert render(people, out, "--size", "32x32", "--resume") == DONE


def test_a_turntable_goes_all_round(people, out):
    assert render(people / "person_000007", out, *SMALL, "--turntable", 3) == DONE
    assert pictures(out) == [f"person_000007/turn_{turn:02d}.png" for turn in range(3)]


def test_a_turntable_keeps_its_distance_and_shows_everything(people):
    bpy.ops.wm.open_mainfile(filepath=str(people / "person_000007" / "person.blend"))
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = 300, 400
    low, high = extent = moving_extent(scene)
    distances = []
    for degrees in (0, 40, 90, 200):
        go_round(scene, degrees, extent)
        bpy.context.view_layer.update()
        distances.append((scene.camera.location - Vector((low + high) / 2)).length)
        for corner in itertools.product(*zip(low, high, strict=True)):
            seen = world_to_camera_view(scene, scene.camera, Vector(corner))
            assert 0 < seen.x < 1
            assert 0 < seen.y < 1
    np.testing.assert_allclose(distances, distances[0], rtol=1e-5)


def test_a_motion_is_rendered_frame_by_frame(people, out, tmp_path):
    np.save(tmp_path / "still.npy", np.zeros((4, 72)))
    assert render(people / "person_000007", out, *SMALL, "--motion", tmp_path / "still.npy", "--frames", "2..3") == DONE
    assert pictures(out) == ["person_000007/0002.png", "person_000007/0003.png"]


def test_a_blend_is_rendered_as_it_is_and_stays_unchanged(people, out):
    blend = people / "person_000007" / "person.blend"
    before = blend.read_bytes()
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = 20
    bpy.ops.wm.save_as_mainfile(filepath=str(blend.with_name("small.blend")))
    assert render(blend.with_name("small.blend"), out) == DONE
    assert pixels(out / "small.png").shape[:2] == (20, 20)
    assert render(blend, out / "turned", *SMALL, "--yaw", 90) == DONE
    assert blend.read_bytes() == before


def test_cycles_draws_the_volumes(people, out):
    words = ("--engine", "cycles", "--samples", 1, "--size", "32x32", "--transparent")
    assert render(people / "person_000007", out, *words) == DONE
    alpha = pixels(out / "person_000007.png")[..., 3]
    assert alpha.max() > 0.2
    assert alpha[0, 0] == 0.0


def test_one_who_fails_is_named_and_does_not_stop_the_others(people, out, capfd):
    (people / "person_000007" / "body.safetensors").write_bytes(b"PK\x03\x04 no more")
    assert render(people, out, *SMALL) == FAILED
    assert pictures(out) == ["person_000008.png"]
    (failed,) = report(out)["failed"]
    assert failed["subject"] == "person_000007"
    assert "body.safetensors" in failed["why"]
    assert not list(out.rglob(".*"))


def test_a_missing_backend_is_reported_at_once(people, out, monkeypatch, capfd):
    def nowhere(*_, **__):
        raise BackendNotFound("No Python for the backend: /nowhere does not exist")

    monkeypatch.setattr("blender_primdiffusion.backend.environment.search", nowhere)
    assert render(people, out, *SMALL) == NO_BACKEND
    assert "/nowhere does not exist" in capfd.readouterr().err
    assert pictures(out) == []


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--size", "big"], "invalid size like 1920x1080 value: 'big'"),
        (["--frames", "9..3"], "invalid range of frames like 1..48 value: '9..3'"),
        (["--turntable", "4", "--frames", "1..3"], "ask for different pictures"),
        (["--samples", "4", "--engine", "primdiffusion"], "the marcher needs none"),
        (["--pose", "/nowhere.npy"], "--pose /nowhere.npy is no file"),
    ],
)
def test_wrong_words_are_named(addon, tmp_path, out, words, sentence, capfd):
    assert render(tmp_path, out, *words) == UNUSABLE
    assert sentence in capfd.readouterr().err


def test_what_is_no_source_is_named(addon, tmp_path, out, capfd):
    (tmp_path / "photo.jpg").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for source, sentence in (
        ("nobody", "there is no"),
        ("photo.jpg", "is neither a .blend nor"),
        ("empty", "no humans"),
    ):
        assert render(tmp_path / source, out) == UNUSABLE
        assert sentence in capfd.readouterr().err


def test_links_where_pictures_go_lose_nothing_outside(people, out, tmp_path):
    mine = tmp_path / "outside" / "mine.png"
    mine.parent.mkdir()
    mine.write_text("mine")
    out.mkdir()
    (out / "person_000007.png").symlink_to(mine.with_name("nothing"))
    (out / "person_000008.png").symlink_to(mine.parent)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert render(people, out, *SMALL) == FAILED
    assert (out / "person_000007.png").stat().st_size > 0
    assert not (out / "person_000007.png").is_symlink()
    assert report(out)["done"] == ["person_000007"]
    assert mine.read_text() == "mine"
    assert not mine.with_name("nothing").exists()
