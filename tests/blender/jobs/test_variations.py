"""The contact sheet: people of many seeds, seen before anything is built, and exactly those that are then built."""

import os
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from blender_primdiffusion.files.picture_files import write_png
from human_files import person_file
from jobs_driven import Layout, drive, error_of, shown, until_running
from support.errors import refused
from support.fake_child import FAILS, TAKES_LONG, request_of

from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.jobs.variations import VariationsJob, sheet
from blender_primdiffusion.jobs.windows import Icons, icons
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui import variations_panel

pytestmark = pytest.mark.any_blender

ops = bpy.ops.primdiffusion


def more_like(**given):
    return ops.variations(like=True, **given)


def select(*indices: int) -> None:
    manager = bpy.context.window_manager
    manager.primdiffusion_selected = [i in indices for i in range(len(manager.primdiffusion_selected))]


@pytest.fixture
def shown_people(addon):
    """A sheet of seeds 11 to 14."""
    addon.scene.primdiffusion_variations.count = "4"
    ops.variations(seed=11)
    return sheet


def seeds() -> list[int]:
    return [variation.seed for variation in sheet.variations]


def sent(file: Path) -> dict:
    return request_of(file)


def files_left() -> list[Path]:
    return list(Path(bpy.app.tempdir).glob("variation*"))


def test_variations_are_files_and_nothing_enters_the_scene(addon, shown_people):
    assert seeds() == [11, 12, 13, 14]
    assert not humans(addon.scene)
    for variation in sheet.variations:
        assert variation.picture.is_file()
        assert sent(variation.person)["seed"] == variation.seed
    assert [path.name.split("_")[1] for path in files_left()] == ["sheet"], "the child's folder is gone"


def test_the_panels_settings_are_requested_and_random_seeds_differ_each_time(addon):
    settings = addon.scene.primdiffusion_variations
    addon.scene.primdiffusion.quality, settings.count = "HIGH", "4"
    ops.variations()
    first = seeds()
    asked = sent(sheet.variations[0].person)
    assert (asked["steps"], asked["sampler"], asked["size"]) == (60, "dpmpp_2m", 256)
    addon.scene.primdiffusion.quality, settings.count = "DRAFT", "8"
    ops.variations()
    assert len(set(seeds())) == 8
    assert set(first).isdisjoint(seeds())
    asked = sent(sheet.variations[0].person)
    assert (asked["steps"], asked["sampler"]) == (8, "dpmpp_2m")


def test_the_one_that_is_built_is_the_very_one_seen_and_one_undo_takes_them_away(addon, shown_people):
    bpy.ops.ed.undo_push(message="before")
    select(2)
    assert ops.build_variation() == {"FINISHED"}
    (person,) = humans(addon.scene)
    assert person_file(person).read_bytes() == sheet.variations[2].person.read_bytes()
    select(0, 3)
    ops.build_variation()
    assert [sent(person_file(person))["seed"] for person in humans(bpy.context.scene)] == [13, 11, 14]
    assert len({person.location.x for person in humans(bpy.context.scene)}) == 3, "side by side"
    bpy.ops.ed.undo()
    assert len(humans(bpy.context.scene)) == 1
    assert [variation.chosen for variation in sheet.variations] == [True, False, False, True], "the sheet stays"
    bpy.ops.ed.undo()
    assert not humans(bpy.context.scene)


def test_whom_files_are_missing_of_is_not_built_and_those_before_stay_in_edit_mode_too(addon, shown_people):
    bpy.ops.object.armature_add()
    bpy.ops.object.mode_set(mode="EDIT")
    sheet.variations[1].person.unlink()
    select(0, 1, 2, 3)
    with refused(RuntimeError, "1 of 4"):
        ops.build_variation()
    assert len(humans(addon.scene)) == 1


def test_nothing_selected_and_no_sheet_are_rejected(addon):
    assert not ops.build_variation.poll()
    with refused(RuntimeError, "Show Variations"):
        more_like()
    ops.variations(seed=11)
    with refused(RuntimeError, "variation"):
        ops.build_variation()
    select(0, 1)
    with refused(RuntimeError, "2 variations"):
        more_like()
    with refused(RuntimeError, "8 seeds", "2147483647"):
        ops.variations(seed=2**31 - 1)


def test_more_like_this_requests_variants_of_the_chosen_human(addon, shown_people):
    select(1)
    kept = sheet.variations[1].person
    addon.scene.primdiffusion_variations.amount, addon.scene.primdiffusion.steps = 0.25, 4
    assert more_like(seed=20) == {"FINISHED"}
    asked = sent(sheet.variations[0].person)
    assert (asked["person"], asked["amount"], asked["steps"]) == (str(kept), 0.25, 4)
    assert seeds() == [20, 21, 22, 23]
    assert sheet.title == "Like seed 12"


def test_a_failure_leaves_the_sheet_that_was_there(addon, shown_people):
    with refused(RuntimeError, "checkpoint"):
        ops.variations(seed=FAILS)
    assert seeds() == [11, 12, 13, 14]
    assert all(variation.person.is_file() for variation in sheet.variations)
    assert "damaged" in error_of("variations")


def test_pictures_appear_one_by_one_while_they_are_made_and_cancelling_keeps_the_old_sheet(
    addon, shown_people, monkeypatch
):
    drawn = []
    monkeypatch.setattr(variations_panel, "_draw_picture", lambda _cell, path, _units: drawn.append(path))
    queue.add(addon, VariationsJob((31, TAKES_LONG, 33), {"steps": 3}))
    until_running()
    while len(queue.request.pictures) < 2:
        queue.tick()
    texts = shown(variations_panel.draw_variations, addon)
    assert [path is not None for path in drawn] == [True, True, False]
    assert {"31", "4", "33", "primdiffusion.cancel"} <= set(texts)
    ops.cancel()
    drive()
    assert seeds() == [11, 12, 13, 14]


def test_the_panel_shows_the_sheet_and_what_can_be_done_with_those_selected(addon, shown_people):
    select(1)
    layout = Layout()
    variations_panel.draw_variations(layout, addon)
    assert layout.of("prop").count("primdiffusion_selected") == 4
    texts = layout.of("text", "button")
    assert {"primdiffusion.build_variation", "New humans: 4"} <= set(texts)
    assert texts.count("primdiffusion.variations") == 2, "show, more like this"


def test_a_click_on_a_seed_selects_and_deselects_it(shown_people):
    selected = bpy.context.window_manager.primdiffusion_selected
    selected[2] = True
    assert [variation.chosen for variation in sheet.variations] == [False, False, True, False]
    assert list(selected)[:4] == [False, False, True, False]
    selected[2] = False
    assert not any(variation.chosen for variation in sheet.variations)


@pytest.mark.parametrize(("width", "columns"), [(300, 2), (420, 3), (2000, 8), (50, 2)])
def test_as_many_pictures_stand_side_by_side_as_fit(width, columns):
    preferences, region = SimpleNamespace(system=SimpleNamespace(ui_scale=2.0)), SimpleNamespace(width=width * 2)
    number, units = variations_panel._columns(SimpleNamespace(preferences=preferences, region=region))
    assert number == columns
    assert number * units * 20 <= max(width, 100)


@pytest.mark.parametrize("end", ["load", "unregister"])
def test_files_and_pictures_go_when_another_file_is_loaded_or_the_extension_ends(shown_people, end):
    icons.of(sheet.variations[0].picture)
    assert files_left()
    if end == "load":
        bpy.ops.wm.read_homefile(use_empty=True)
    else:
        import blender_primdiffusion

        blender_primdiffusion.unregister()
        blender_primdiffusion.register()
    assert not sheet.variations
    assert icons._previews is None
    assert not files_left()


def test_a_person_cleared_before_its_turn_is_named(addon, shown_people):
    queue.add(addon, VariationsJob((1,), {"steps": 1}, person=str(sheet.variations[0].person)))
    sheet.clear()
    drive()
    assert "the human to vary was cleared" in error_of("variations").lower()


def test_a_disk_that_is_full_keeps_the_former_sheet(addon, shown_people, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("blender_primdiffusion.jobs.variations.shutil.move", full)
    with refused(RuntimeError, "space"):
        ops.variations(seed=40)
    assert seeds() == [11, 12, 13, 14]
    assert len(files_left()) == 1


def painted(path: Path, green: int) -> Path:
    write_png(path, np.full((8, 8, 3), (0, green, 0), np.uint8))
    os.utime(path, ns=((green + 1) * 10**9,) * 2)
    return path


def test_a_picture_that_is_written_again_is_read_again_and_one_that_is_gone_is_let_go(tmp_path):
    own, path = Icons(), tmp_path / "a.png"
    for green in (0, 99):
        own.of(painted(path, green))
        assert own._previews[str(path)].image_pixels_float[1] == pytest.approx(green / 255, abs=0.01)
    path.unlink()
    assert own.of(path) == own.of(None) == 0
    own.of(painted(tmp_path / "b.png", 9))
    assert list(own._previews) == [str(tmp_path / "b.png")]
    own.free()
    own.free()
