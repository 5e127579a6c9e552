"""Where the extension keeps things."""

import pytest

from blender_primdiffusion import places

pytestmark = pytest.mark.any_blender


def test_caches_are_our_own_unless_a_folder_is_named(monkeypatch, tmp_path):
    monkeypatch.delenv("PRIMDIFFUSION_CACHE")
    assert places.cache_folder() is None  # a checkout
    monkeypatch.setattr(places, "EXTENSION", "bl_ext.user_default.primdiffusion")
    monkeypatch.setattr(places, "own_folder", lambda: tmp_path / "own")
    assert places.cache_folder() == tmp_path / "own" / "cache"
    monkeypatch.setenv("PRIMDIFFUSION_CACHE", str(tmp_path))
    assert places.cache_folder() == tmp_path
