"""Captures that several files look at, and copies to damage."""

import shutil
from pathlib import Path

import pytest
from capture_scenes import captured


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Path:
    """Two people in three poses from four sides, all passes; not to be changed. The people are beside them."""
    return captured(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def root(whole, tmp_path) -> Path:
    """A copy, also of the people."""
    shutil.copytree(whole.parent, tmp_path / "copy")
    return tmp_path / "copy" / whole.name
