"""Set Up Backend and its neighbours as operators: what they do, what they refuse, what panels show."""

from __future__ import annotations

import re
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import pytest
from jobs_driven import Layout
from support.errors import refused
from support.fake_child import FAKE_CHILD
from tiny_packages import own_index, served, until, with_this_pip, write_lock, write_packages

import blender_primdiffusion
import build_addon
from blender_primdiffusion import places
from blender_primdiffusion.backend import setup
from blender_primdiffusion.backend.environment import VARIABLE
from blender_primdiffusion.ui import preferences
from blender_primdiffusion.ui import setup as ui_setup
from blender_primdiffusion.ui.preferences import known
from blender_primdiffusion.ui.setup import session

pytestmark = pytest.mark.any_blender

press = bpy.ops.primdiffusion


@pytest.fixture
def wheels(empty_scene, tmp_path, monkeypatch) -> Path:
    """The add-on registered, no backend yet; a folder with all wheels that it needs."""
    folder = tmp_path / "große räder"
    lock = write_lock(tmp_path / "lock.txt", write_packages(folder))
    monkeypatch.delenv(VARIABLE, raising=False)
    own_index(monkeypatch)
    with_this_pip(monkeypatch, setup)
    monkeypatch.setattr("blender_primdiffusion.backend.environment.short_root", lambda *_: tmp_path / "eigener ordner")
    monkeypatch.setattr(places, "backend_module_path", lambda: FAKE_CHILD)
    monkeypatch.setattr("blender_primdiffusion.ui.setup.backend_module_path", lambda: FAKE_CHILD)
    monkeypatch.setattr(preferences, "own_python_has_backend", lambda **_: False)
    monkeypatch.setattr(ui_setup, "available", lambda: {"cpu": lock})
    bpy.context.preferences.system.use_online_access = False
    session.error = session.notice = ""
    blender_primdiffusion.register()
    yield folder
    blender_primdiffusion.unregister()
    bpy.context.preferences.system.use_online_access = False


@pytest.fixture
def online(wheels):
    bpy.context.preferences.system.use_online_access = True
    return wheels


@pytest.fixture
def index(online, monkeypatch):
    with served(online) as (address, _):
        own_index(monkeypatch, address)
        yield address


def said(layout: Layout) -> str:
    return " ".join(layout.of("text"))


def draw_preferences() -> Layout:
    layout = Layout()
    preferences.PRIMDIFFUSION_AP_preferences.draw(type("Preferences", (), {"layout": layout})(), bpy.context)
    return layout


def test_from_no_backend_to_a_backend_that_is_repaired_and_outdated(index, monkeypatch):
    layout = Layout()
    assert not preferences.draw_set_up(layout)
    assert "The backend is not set up yet" in said(layout)
    assert "Downloads" in said(layout)
    assert "primdiffusion.set_up_backend" in layout.of("button")

    assert press.set_up_backend() == {"FINISHED"}
    assert known().state == "ready"
    assert session.notice.startswith("The backend is ready: torch 0-tiny")
    layout = Layout()
    assert preferences.draw_set_up(layout)
    assert not layout.of("text")
    layout = draw_preferences()
    assert "Ready: torch 0-tiny" in said(layout)
    assert str(places.set_up_folder().environment).replace(" ", "") in said(layout).replace(" ", "")
    assert "primdiffusion.set_up_backend" in layout.of("button")

    assert press.set_up_backend() == {"FINISHED"}  # nothing to do
    next(places.set_up_folder().environment.rglob("tiny.py")).unlink()
    assert press.set_up_backend(repair=True) == {"FINISHED"}
    assert known().state == "ready"
    assert list(places.set_up_folder().environment.rglob("tiny.py"))

    (path,) = ui_setup.available().values()
    monkeypatch.setattr(ui_setup, "LOCKS", path.parent)
    path.write_text(path.read_text() + "# another\n")
    ui_setup.read_once.cache_clear()
    assert known().state == "outdated"
    assert "press Repair" in known().line
    bpy.context.preferences.system.use_online_access = False
    with refused(RuntimeError, "Blender"):
        press.set_up_backend(repair=True)
    assert known().state == "outdated"  # still there, and it works


def test_without_online_access_set_up_is_rejected_with_the_remedy(wheels):
    with refused(RuntimeError, "Allow Online Access"):
        press.set_up_backend()
    layout = Layout()
    preferences.draw_set_up(layout)
    assert "may not use the network" in said(layout)
    assert "extensions.userpref_allow_online" in layout.of("button")
    assert not places.set_up_folder().root.exists()


def test_a_failure_raises_and_stays_in_the_panel(online):
    with refused(RuntimeError, "package"):
        press.set_up_backend()
    layout = Layout()
    preferences.draw_set_up(layout)
    assert "cannot be reached" in said(layout)
    assert "Half installed" in said(layout)
    assert "extensions.userpref_allow_online" not in layout.of("button")
    assert "wm.path_open" in draw_preferences().of("button")


def test_while_one_is_under_way_a_second_is_rejected_and_cancel_ends_it(online, tmp_path, monkeypatch):
    with served(online, stalls="torch") as (index, handler):
        own_index(monkeypatch, index)
        session.start(ui_setup.installing())
        until(lambda: session.tick() is None or any(path.startswith("/torch-") for path in handler.asked))
        layout = Layout()
        assert not preferences.draw_set_up(layout)
        assert layout.of("button") == ["primdiffusion.cancel"]
        with refused(RuntimeError, "already"):
            press.set_up_backend(repair=True)
        assert press.cancel(what="SET_UP") == {"FINISHED"}
    assert not session.busy
    assert session.notice.startswith("Cancelled")
    assert known().state == "broken"


def test_a_machine_without_packages_gets_an_error_with_a_remedy(online, monkeypatch):
    monkeypatch.setattr(ui_setup, "available", dict)
    with refused(RuntimeError, "environment"):
        press.set_up_backend()
    layout = Layout()
    preferences.draw_set_up(layout)
    assert "There are no packages for" in said(layout)


def test_set_up_is_rejected_while_a_person_is_made(online, monkeypatch):
    from blender_primdiffusion.jobs.queue import Queue

    monkeypatch.setattr(Queue, "busy", property(lambda self: True))
    with refused(RuntimeError, "backend"):
        press.set_up_backend()


def test_disabling_the_extension_ends_a_set_up(online, monkeypatch):
    with served(online, stalls="torch") as (index, _):
        own_index(monkeypatch, index)
        session.start(ui_setup.installing())
        blender_primdiffusion.unregister()
        blender_primdiffusion.register()
    assert not session.busy


def test_the_preferences_show_what_it_costs(wheels):
    layout = draw_preferences()
    assert re.search(r"Downloads \d+ MB, takes \d+ MB on disk", said(layout))
    assert {"compute", "backend_python", "checkpoint"} <= set(layout.of("prop"))


def test_the_zip_holds_the_locks_and_asks_for_the_network():
    names = build_addon.contents()
    assert "requirements/linux_x86_64-py311-cpu.txt" in names
    assert "requirements/windows_x86_64-py313-cuda.txt" in names
    manifest = (build_addon.ADDON / "blender_manifest.toml").read_text()
    reason = re.search(r'^network = "(.+)"$', manifest, re.MULTILINE)
    assert len(reason[1]) <= 64


@pytest.fixture
def alone(addon, monkeypatch):
    """The viewer, and no backend anywhere."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(preferences, "setup", None)
    monkeypatch.setattr(preferences, "own_python_has_backend", lambda **_: False)
    monkeypatch.setattr(preferences, "installed_backend", lambda: None)


def test_without_a_backend_the_panel_says_what_to_do_and_opens_the_preferences(alone):
    layout = MagicMock()
    assert not preferences.draw_set_up(layout)
    assert layout.box().operator.call_args.args == ("preferences.addon_show",)
    assert preferences.known().line.startswith("There is no backend on this computer: install")


def test_a_program_on_the_path_is_found_and_one_in_the_preferences_goes_first(alone, monkeypatch):
    monkeypatch.setattr(preferences, "installed_backend", lambda: Path("/opt/primdiffusion"))
    assert preferences.draw_set_up(MagicMock())
    assert preferences.known().line == "Uses /opt/primdiffusion, named by the PATH"
    monkeypatch.setattr(preferences, "preference", lambda _name: "/mine/bin/python")
    assert preferences.known().line == "Uses /mine/bin/python, named by the extension's preferences"
