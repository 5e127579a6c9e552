"""Pictures of assets."""

import numpy as np
import pytest
from PIL import Image
from primdiffusion.files.regular_files import FileError
from primdiffusion.people.assets import _decoded
from support.errors import refused


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_a_picture_shrunk_in_strips_is_pillows(tmp_path, monkeypatch, mode):
    noise = np.random.default_rng(0).integers(0, 256, (301, 207, 4), dtype=np.uint8)
    Image.fromarray(noise).convert(mode).save(tmp_path / "a.png")
    monkeypatch.setattr("primdiffusion.geometry.pictures.STRIP_PIXELS", 5000)
    whole = Image.fromarray(noise).convert(mode).convert("RGBA").convert("RGBa")
    expected = whole.resize((50, round(301 * 50 / 207)), Image.Resampling.BOX).convert("RGBA")
    assert np.array_equal(_decoded(tmp_path / "a.png", 50), np.asarray(expected))


def test_a_picture_that_claims_more_than_its_file_can_hold_is_rejected(tmp_path):
    Image.new("1", (8000, 8000)).save(tmp_path / "a.png")
    with refused(FileError, "a.png", "8000"):
        _decoded(tmp_path / "a.png", 50)
