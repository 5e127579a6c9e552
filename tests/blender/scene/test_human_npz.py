"""human.npz: a sentence says what is wrong with a file."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic
from support.errors import refused

from blender_primdiffusion.scene.human_npz import HumanNpzError, read_human

pytestmark = pytest.mark.any_blender

SPOILED = {
    "NaN or infinite": {"density": np.full((4, 8, 8, 8), np.nan, np.float32)},
    "'rgb'.*instead of numbers of shape": {"rgb": np.zeros((4, 3, 8, 8, 8), np.float16)},
    "'half_extent'.*instead of numbers of shape": {"half_extent": np.ones((3, 3))},
    "'joints'.*instead of numbers": {"joints": np.full((24, 3), "x")},
    "'rotation'.*impossible": {"rotation": np.tile(np.diag([1.0, 1.0, -1.0]), (4, 1, 1))},
    "'half_extent'.*impossible": {"half_extent": np.zeros((4, 3))},
    "'density'.*impossible": {"density": np.full((4, 8, 8, 8), -1, np.float32)},
    "'primitive_weights'.*impossible": {"primitive_weights": np.full((4, 24), 0.5)},
    "'faces'.*impossible": {"faces": np.full((1104, 3), 10**6)},
    "version 3.*reads 1 to 2": {"format_version": np.array(3)},
    "'uv_corner'.*NaN or infinite": {"uv_corner": np.full((1104, 3, 2), 1e39)},
    "no full density": {"meta": np.array('{"full_density": -3}')},
    "no provenance": {"meta": np.array("[]")},
    "is damaged": {"format_version": np.array("two")},
    "nested more than 64 deep": {"meta": np.array("[" * 100_000)},
    "not JSON": {"meta": np.array("{")},
    "not SMPL's 24 joints": {"joint_names": np.array(["bone"] * 24)},
}


def test_a_good_file_gives_back_its_arrays(tmp_path):
    wanted = synthetic.arrays(4)
    human = read_human(synthetic.write(tmp_path / "human.npz", 4))
    assert human.meta["seed"] == 0
    for name in ("joints", "vertices", "position", "rotation", "half_extent", "primitive_weights", "rgb", "density"):
        np.testing.assert_array_equal(getattr(human, name), wanted[name])


@pytest.mark.parametrize("sentence", SPOILED)
def test_a_broken_field_is_named_in_one_sentence(tmp_path, sentence):
    path = synthetic.write(tmp_path / "human.npz", 4, **SPOILED[sentence])
    with pytest.raises(HumanNpzError, match=sentence) as caught:
        read_human(path)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)  # the remedy


def test_a_missing_field_is_named(tmp_path):
    arrays = synthetic.arrays(4)
    del arrays["density"]
    np.savez(tmp_path / "human.npz", **arrays)
    with refused(HumanNpzError, "density"):
        read_human(tmp_path / "human.npz")


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.99])
def test_a_truncated_file_is_damaged(tmp_path, keep):
    path = synthetic.write(tmp_path / "human.npz", 4)
    contents = path.read_bytes()
    path.write_bytes(contents[: keep if isinstance(keep, int) else int(len(contents) * keep)])
    with refused(HumanNpzError, "damaged"):
        read_human(path)


def test_a_flipped_byte_inside_an_array_is_damaged(tmp_path):
    path = synthetic.write(tmp_path / "human.npz", 4)
    contents = bytearray(path.read_bytes())
    contents[len(contents) // 2] ^= 255
    path.write_bytes(contents)
    with refused(HumanNpzError, "damaged"):
        read_human(path)


def test_a_missing_file_is_named(tmp_path):
    with refused(HumanNpzError, "nobody.npz"):
        read_human(tmp_path / "nobody.npz")


def test_pickles_are_never_opened(tmp_path):
    np.savez(tmp_path / "human.npz", **{**synthetic.arrays(4), "betas": np.array([{"a": 1}], dtype=object)})
    with refused(HumanNpzError, "damaged"):
        read_human(tmp_path / "human.npz")
