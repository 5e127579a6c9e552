""".human files: the extension writes them with numpy alone, the backend reads them."""

import numpy as np
import pytest
import torch
from export_people import person
from primdiffusion.editing.reshaping import reshaped as reshape_in_backend
from primdiffusion.human_file import load_human, save_human
from support.errors import refused

from blender_primdiffusion.scene.human_file import (
    HumanMotion,
    motion_in,
    read_tensors,
    reshaped,
    with_motion,
    write_tensors,
)
from blender_primdiffusion.scene.rest_human import default_body


@pytest.fixture
def saved(tmp_path):
    save_human(tmp_path / "a.human", person())
    return tmp_path / "a.human"


def walk(frames=3):
    turns = np.tile(np.eye(3, dtype=np.float32), (frames, 24, 1, 1))
    return HumanMotion(np.arange(frames, dtype=np.float32), turns, np.ones((frames, 3), np.float32), 24.0)


def test_a_file_taken_apart_and_written_again_is_the_same_person(saved, tmp_path):
    write_tensors(tmp_path / "b.human", read_tensors(saved))
    again = load_human(tmp_path / "b.human")
    assert again.payload.density.equal(person().payload.density)
    assert again.payload.rgb.equal(person().payload.rgb)
    assert dict(again.provenance) == {"seed": 1}


def test_a_reshaped_person_in_a_file_is_the_backends_reshaped_person(saved, tmp_path):
    betas = np.linspace(-1.5, 1.5, 10).astype(np.float32)
    kept = reshaped(read_tensors(saved), betas, default_body().growth(person().betas.numpy(), betas))
    write_tensors(tmp_path / "b.human", with_motion(kept, walk()))
    again, wanted = load_human(tmp_path / "b.human"), reshape_in_backend(person(), torch.tensor(betas))
    assert again.betas.equal(wanted.betas)
    assert torch.allclose(again.payload.delta_scale, wanted.payload.delta_scale, rtol=1e-5)
    assert wanted.payload.delta_scale.max() > 1.05 * person().payload.delta_scale.max()


def test_boxes_of_another_body_are_rejected(saved):
    with refused(ValueError, "[5, 3]", "generate"):
        reshaped(read_tensors(saved), np.zeros(10), np.ones((5, 3)))


def test_a_motion_comes_back_as_it_was_and_can_be_taken_away(saved, tmp_path):
    write_tensors(tmp_path / "b.human", with_motion(read_tensors(saved), walk()))
    found = motion_in(read_tensors(tmp_path / "b.human"), "b.human")
    assert found is not None
    assert found.fps == 24.0
    assert np.array_equal(found.translations, walk().translations)
    write_tensors(tmp_path / "c.human", with_motion(read_tensors(tmp_path / "b.human"), None))
    assert motion_in(read_tensors(tmp_path / "c.human"), "c.human") is None


@pytest.mark.parametrize("damage", ["fps", "order", "shape", "single"])
def test_a_damaged_motion_is_rejected_with_a_sentence(saved, damage):
    motion = walk()
    if damage == "order":
        motion = HumanMotion(motion.frames[::-1].copy(), motion.rotations, motion.translations, 24.0)
    if damage == "shape":
        motion = HumanMotion(motion.frames, motion.rotations[:2], motion.translations, 24.0)
    human = with_motion(read_tensors(saved), motion)
    if damage == "single":
        human.arrays["motion.frames"] = ("F32", (), bytes(4))
    if damage == "fps":
        human.metadata["motion"] = '{"fps": "fast"}'
    with refused(ValueError, "human"):
        motion_in(human, "b.human")


@pytest.mark.parametrize("change", [np.diag([1, 1, 1.002]), np.diag([1, 1, -1]), np.zeros((3, 3))])
def test_a_motion_with_a_matrix_that_is_not_a_rotation_is_rejected_by_frame_and_joint(saved, change):
    motion = walk()
    motion.rotations[2, 4] = change
    with refused(ValueError, "b.human", "left_knee", "frame 2"):
        motion_in(with_motion(read_tensors(saved), motion), "b.human")


def test_a_file_that_cannot_be_finished_leaves_the_old_one(saved, monkeypatch):
    before = saved.read_bytes()
    human = read_tensors(saved)
    human.arrays["zzz"] = ("U8", (1,), None)  # type: ignore[assignment]
    with pytest.raises(TypeError):
        write_tensors(saved, human)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]
