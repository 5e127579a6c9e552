"""The panel Generate: seeds, counts, quality, and people who stand side by side."""

import random
import re
from types import SimpleNamespace

import bpy
import pytest
from human_files import person_file
from jobs_driven import Layout, drive, shown
from support.errors import refused
from support.fake_child import FAILS, request_of

from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui import generate_panel

pytestmark = pytest.mark.any_blender


@pytest.fixture
def panel_settings(addon):
    return addon.scene.primdiffusion


@pytest.fixture
def queued_jobs(monkeypatch):
    """Works as with a window: submit returns at once, and `drive` is the timer."""
    monkeypatch.setattr(
        generate_panel, "submit", lambda _operator, context, job: queue.add(context, job) and {"FINISHED"}
    )


def seeds(context) -> list[int]:
    return [request_of(person_file(person))["seed"] for person in humans(context.scene)]


def test_an_unlocked_seed_is_another_one_after_each_result_and_a_locked_one_stays(addon, panel_settings, monkeypatch):
    monkeypatch.setattr(random, "randrange", lambda _: 99)
    panel_settings.seed = 11
    bpy.ops.primdiffusion.generate()
    assert (seeds(addon), panel_settings.seed) == ([11], 99)
    panel_settings.keep_seed, panel_settings.seed = True, 12
    bpy.ops.primdiffusion.generate()
    assert panel_settings.seed == 12
    panel_settings.keep_seed, panel_settings.seed, panel_settings.count = False, FAILS, 3
    with refused(RuntimeError):
        bpy.ops.primdiffusion.generate()
    assert panel_settings.seed == FAILS, "for another try"
    bpy.ops.primdiffusion.generate(seed=31)
    assert (seeds(addon), panel_settings.seed) == ([11, 12, 31], FAILS), "one of a script leaves the panel's"


def test_pressing_twice_generates_two_different_humans(addon, panel_settings, queued_jobs):
    bpy.ops.primdiffusion.generate()
    bpy.ops.primdiffusion.generate()
    drive()
    first, second = seeds(addon)
    assert first == 10
    assert second != 10


def test_a_count_queues_as_many_jobs_with_consecutive_seeds(addon, panel_settings, queued_jobs):
    panel_settings.count = 3
    bpy.ops.primdiffusion.generate()
    assert [entry.job.label for entry in queue.waiting] == [f"Human, seed {seed}" for seed in (10, 11, 12)]
    drive()
    assert seeds(addon) == [10, 11, 12]
    assert panel_settings.seed not in (10, 11, 12)


def test_a_new_person_takes_the_free_place_in_the_middle(addon):
    bpy.ops.primdiffusion.generate(seed=7)
    humans(addon.scene)[0].location.x = 30.0
    bpy.ops.primdiffusion.generate(seed=8)
    assert humans(addon.scene)[1].location.x == 0.0
    humans(addon.scene)[1].location.y = 5.0
    bpy.ops.primdiffusion.generate(seed=9)
    assert humans(addon.scene)[2].location.x == 0.0, "the one far behind is not in the way"


def test_seeds_beyond_blenders_numbers_are_rejected(addon, panel_settings):
    panel_settings.seed, panel_settings.count = 2**31 - 1, 2
    with refused(RuntimeError, "2 seeds", "2147483647"):
        bpy.ops.primdiffusion.generate()
    assert not humans(addon.scene)


def test_a_quality_stands_for_steps_and_sampler_and_these_name_the_quality(panel_settings):
    assert (panel_settings.quality, panel_settings.steps, panel_settings.sampler) == ("STANDARD", 20, "dpmpp_2m")
    panel_settings.quality = "DRAFT"
    assert (panel_settings.quality, panel_settings.steps, panel_settings.sampler) == ("DRAFT", 8, "dpmpp_2m")
    panel_settings.quality = "HIGH"
    assert (panel_settings.quality, panel_settings.steps, panel_settings.sampler) == ("HIGH", 60, "dpmpp_2m")
    panel_settings.steps = 17
    assert panel_settings.quality == "CUSTOM"
    panel_settings.steps = 20
    assert panel_settings.quality == "STANDARD"
    panel_settings.quality = "CUSTOM"
    assert (panel_settings.quality, panel_settings.steps) == ("CUSTOM", 20)


def test_the_panel_shows_steps_where_the_quality_is_custom_and_what_is_missing_of_the_backend(
    addon, panel_settings, monkeypatch
):
    def drawn() -> list[str]:
        layout = Layout()
        generate_panel.PRIMDIFFUSION_PT_generate.draw(SimpleNamespace(layout=layout), addon)
        return layout.of("prop")

    assert drawn() == ["seed", "keep_seed", "count", "quality"]
    panel_settings.quality = "CUSTOM"
    assert drawn() == ["seed", "keep_seed", "count", "quality", "steps", "sampler"]
    monkeypatch.setattr(generate_panel, "draw_set_up", lambda layout: layout.label(text="not set up"))
    texts = shown(generate_panel.PRIMDIFFUSION_PT_generate, addon)
    assert texts[:2] == ["not set up", "primdiffusion.import_human"]
    assert "primdiffusion.generate" in texts


@pytest.mark.parametrize(
    ("engine", "button"),
    [
        ("PRIMDIFFUSION", "render.render"),
        ("CYCLES", "render.render"),
        ("BLENDER_WORKBENCH", "primdiffusion.set_up_engine"),
    ],
)
def test_after_success_the_panel_has_one_line_and_the_button_of_the_next_step(addon, engine, button):
    scene, panel = addon.scene, generate_panel.PRIMDIFFUSION_PT_generate
    scene.render.engine = engine
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    before = shown(panel, addon)
    bpy.ops.primdiffusion.generate(seed=7)
    line, next_step = (text for text in shown(panel, addon) if text not in before)
    assert re.fullmatch(r"Generated in [0-9.]+ s\.", line)
    assert next_step == button
    queue.add(addon, GenerateJob(4, {"steps": 5}))
    assert "primdiffusion.set_up_engine" not in shown(panel, addon), "while a job is running"
