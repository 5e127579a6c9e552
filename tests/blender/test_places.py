"""Where the extension keeps things."""

from __future__ import annotations

import pytest

from blender_primdiffusion import places
from blender_primdiffusion.backend import setup
from blender_primdiffusion.ui.setup import operators

pytestmark = pytest.mark.any_blender


def test_caches_are_our_own_unless_a_folder_is_named(monkeypatch, tmp_path):
    monkeypatch.delenv("PRIMDIFFUSION_CACHE")
    assert places.cache_folder().is_relative_to(places.own_folder())
    monkeypatch.setenv("PRIMDIFFUSION_CACHE", str(tmp_path))
    assert places.cache_folder() == tmp_path


def test_set_up_uses_the_folder_that_children_use_and_removes_it_only_where_it_is_ours(
    empty_scene, monkeypatch, tmp_path
):
    removed = []
    monkeypatch.setattr(setup, "remove", lambda _folder, cache: removed.append(cache))
    monkeypatch.delenv(places.CACHE_VARIABLE)
    operators.removing()
    monkeypatch.setenv(places.CACHE_VARIABLE, str(tmp_path))
    assert places.cache_folder() == tmp_path
    operators.removing()
    assert removed == [places.own_folder() / "cache", None]
