""".human files: the extension writes them with numpy alone, the backend reads them."""

import numpy as np
import pytest
import torch
from export_people import person
from primdiffusion.editing.reshaping import reshaped as reshape_in_backend
from primdiffusion.human_file import load_human, save_human
from support.errors import refused

from blender_primdiffusion.scene.human_file import (
    default_body,
    read_tensors,
    reshaped,
    write_tensors,
)


@pytest.fixture
def saved(tmp_path):
    save_human(tmp_path / "a.human", person())
    return tmp_path / "a.human"


def test_a_file_taken_apart_and_written_again_is_the_same_person(saved, tmp_path):
    write_tensors(tmp_path / "b.human", read_tensors(saved))
    again = load_human(tmp_path / "b.human")
    assert again.payload.density.equal(person().payload.density)
    assert again.payload.rgb.equal(person().payload.rgb)
    assert dict(again.provenance) == {"seed": 1}


def test_a_reshaped_person_in_a_file_is_the_backends_reshaped_person(saved, tmp_path):
    betas = np.linspace(-1.5, 1.5, 10).astype(np.float32)
    kept = reshaped(read_tensors(saved), betas, default_body().growth(person().betas.numpy(), betas))
    write_tensors(tmp_path / "b.human", kept)
    again, wanted = load_human(tmp_path / "b.human"), reshape_in_backend(person(), torch.tensor(betas))
    assert again.betas.equal(wanted.betas)
    assert torch.allclose(again.payload.delta_scale, wanted.payload.delta_scale, rtol=1e-5)
    assert wanted.payload.delta_scale.max() > 1.05 * person().payload.delta_scale.max()


def test_boxes_of_another_body_are_rejected(saved):
    with refused(ValueError, "[5, 3]", "generate"):
        reshaped(read_tensors(saved), np.zeros(10), np.ones((5, 3)))


def test_a_file_that_cannot_be_finished_leaves_the_old_one(saved, monkeypatch):
    before = saved.read_bytes()
    human = read_tensors(saved)
    human.arrays["zzz"] = ("U8", (1,), None)  # type: ignore[assignment]
    with pytest.raises(TypeError):
        write_tensors(saved, human)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]
