"""MakeHuman's assets, where there are any."""

import os
from pathlib import Path

import pytest
from primdiffusion.people.assets import ENVIRONMENT_VARIABLE, open_assets
from primdiffusion.people.wardrobe import required_meshes

NEARBY = Path(__file__).resolve().parents[4] / "shared" / "data" / "makehuman"


@pytest.fixture(scope="module")
def assets():
    folder = os.environ.get(ENVIRONMENT_VARIABLE, NEARBY if NEARBY.is_dir() else None)
    if folder is None:
        pytest.skip(f"needs a MakeHuman asset folder: set {ENVIRONMENT_VARIABLE}")
    return open_assets(folder, required_meshes())
