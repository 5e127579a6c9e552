"""Blender's own menus offer what works."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import pytest
from jobs_driven import Layout, shown, until_running

from blender_primdiffusion.jobs import windows
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.ui import menus, preferences

pytestmark = pytest.mark.any_blender


def offered(monkeypatch, named: bool, state: str = "ready") -> list[str]:
    """Operators of Add > Human, with and without a backend, and a Python that runs it."""
    monkeypatch.setattr(menus, "backend_is_named", lambda: named)
    monkeypatch.setattr(menus, "known", lambda: preferences.Known(state, ""))
    return shown(menus.PRIMDIFFUSION_MT_add, bpy.context)


@pytest.mark.parametrize("named", [True, False])
def test_add_human_offers_what_works_with_and_without_a_backend(addon, monkeypatch, named):
    always = ["primdiffusion.import_human"] * 2  # a sample, a file
    with_backend = ["primdiffusion.generate", "primdiffusion.choose_picture"]
    assert offered(monkeypatch, named) == (with_backend + always if named else always)
    unready = offered(monkeypatch, named, "absent")
    assert unready == (["preferences.addon_show", *always] if named else always)


def test_the_entries_come_and_go_with_the_extension(addon):
    assert menus.draw_add in bpy.types.VIEW3D_MT_add._dyn_ui_initialize()
    assert menus.draw_import in bpy.types.TOPBAR_MT_file_import._dyn_ui_initialize()
    menus.unregister()
    try:
        assert menus.draw_add not in bpy.types.VIEW3D_MT_add._dyn_ui_initialize()
    finally:
        menus.register()


def test_the_status_bar_shows_the_running_job_and_is_redrawn_with_it(addon, monkeypatch):
    def in_status_bar() -> list[str]:
        layout = Layout()
        menus.draw_status(SimpleNamespace(layout=layout), addon)
        return layout.of("text", "button")

    assert not in_status_bar()
    queue.add(addon, GenerateJob(11, {"steps": 4}))
    until_running()
    progress, button = in_status_bar()
    assert progress.startswith(queue.request.message)
    assert button == "primdiffusion.cancel"
    queue.drop()
    windows.redraw()  # Blender takes the key
    published = []
    monkeypatch.setattr(bpy.msgbus, "publish_rna", lambda *, key: published.append(key))
    windows.redraw()
    assert published == [(bpy.types.ViewLayer, "name")]
