"""Both programs' readers of .human files accept the same files."""

import contextlib
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from export_people import person
from primdiffusion.body.model import default_body as backend_body
from primdiffusion.editing.reshaping import reshaped as reshape_in_backend
from primdiffusion.files import tensor_file
from primdiffusion.human import Human, generate, place
from primdiffusion.human_file import load_human, save_body, save_human
from primdiffusion.primitives.anchors import default_anchors
from support.errors import refused
from tiny_model import tiny_model

from blender_primdiffusion.jobs.export import opened
from blender_primdiffusion.scene.human_file import (
    HumanMotion,
    body_arrays,
    compacted,
    expanded,
    motion_in,
    read_payload,
    read_tensors,
    reshaped,
    with_motion,
    write_tensors,
)
from blender_primdiffusion.scene.rest_human import default_body, read_human

Tensors = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("human") / "a.human"
    save_human(path, generate(tiny_model(), seed=3, steps=2))
    return path


def version(text: str) -> Callable[[Tensors, dict[str, str]], object]:
    return lambda _, metadata: metadata.update(format_version=text)


def provenance(text: str) -> Callable[[Tensors, dict[str, str]], object]:
    return lambda _, metadata: metadata.update(provenance=text)


@pytest.mark.parametrize(
    ("change", "is_read"),
    [
        (version("01"), True),
        (version("4"), False),
        (version(""), False),
        (provenance('{"seed": "seven"}'), False),
        (provenance('{"unknown": NaN}'), False),
        (provenance(json.dumps("\0")), False),
        (lambda _, metadata: metadata.update(compact="{}"), False),
        (lambda tensors, _: tensors.update(rgb=tensors["rgb"].bfloat16()), True),
        (lambda tensors, _: tensors.update(unknown=torch.full((2,), torch.nan)), True),
        (lambda tensors, _: tensors.update(rest_half_extent=torch.ones(3)), False),
        (lambda tensors, _: tensors.update(rest_half_extent=torch.full((1024, 3), 1e6)), False),
        (lambda tensors, _: tensors.update(betas=torch.full((10,), 5.5)), False),
        (lambda tensors, _: tensors.pop("density"), False),
        (lambda tensors, _: tensors.update(density=tensors["density"][:512]), False),
        (lambda tensors, _: tensors.update(density=tensors["density"].reshape(512, 2, 8, 8, 8)), False),
        (lambda tensors, _: tensors.update(density=tensors["density"].int()), False),
        (lambda tensors, _: tensors["density"].view(-1)[:1].fill_(torch.nan), False),
    ],
)
def test_both_readers_give_one_verdict(whole, tmp_path, change, is_read):
    tensors, metadata = tensor_file.read(whole)
    change(tensors, metadata)
    path = tmp_path / "a.human"
    path.write_bytes(tensor_file.save(tensors, metadata))
    for read in (read_human, load_human):
        with contextlib.nullcontext() if is_read else refused(ValueError, "a.human"):
            read(path)


@pytest.fixture(scope="module")
def human() -> Human:
    generator = torch.Generator().manual_seed(3)
    payload = dataclasses.replace(
        person().payload,
        rgb=torch.rand(person().payload.rgb.shape, generator=generator) ** 2,
        density=100 * torch.rand(person().payload.density.shape, generator=generator) ** 4,
        delta_scale=0.8 + 0.4 * torch.rand(person().payload.delta_scale.shape, generator=generator),
    )
    return dataclasses.replace(person(), payload=payload, betas=torch.linspace(-2, 2, 10))


def test_the_default_body_is_the_backends(tmp_path):
    save_body(tmp_path / "body.safetensors", backend_body(), default_anchors())
    wanted = body_arrays(tmp_path / "body.safetensors")
    model = default_body()
    assert {name for name in vars(model) if getattr(model, name) is not None} == set(wanted)
    for name, values in wanted.items():
        assert getattr(model, name).dtype == values.dtype, name
        assert np.allclose(getattr(model, name), values, rtol=0, atol=1e-5), name


def test_a_human_at_rest_is_the_backends_in_the_t_pose(human, tmp_path):
    save_human(tmp_path / "a.human", human)
    found, wanted = read_human(tmp_path / "a.human"), place(human)
    assert np.allclose(found.rest.position, wanted.position, atol=1e-5)
    assert np.allclose(found.rest.rotation, wanted.rotation, atol=1e-4)
    assert np.allclose(found.grids().half_extent, wanted.half_extent, atol=1e-6)


def test_what_is_opened_is_a_whole_human(human, tmp_path):
    save_human(tmp_path / "a.human", human, compact=True)
    result = opened(tmp_path / "a.human", tmp_path)
    assert np.allclose(read_human(result.person).payload.betas, human.betas)
    assert load_human(result.person).betas.equal(human.betas)


def test_a_compact_file_is_a_quarter_of_the_size_and_the_same_to_both_programs(human, tmp_path):
    plain, ours, theirs = (tmp_path / name for name in ("plain.human", "ours.human", "theirs.human"))
    save_human(plain, human)
    save_human(theirs, human, compact=True)
    write_tensors(ours, compacted(read_tensors(plain)))
    assert theirs.stat().st_size < 0.26 * plain.stat().st_size
    payload = load_human(theirs).payload
    for path in (ours, theirs):
        assert np.array_equal(read_payload(path).rgb, payload.rgb.numpy())
        assert np.array_equal(read_payload(path).density, load_human(ours).payload.density.numpy())
    assert (payload.density.sqrt() - human.payload.density.sqrt()).abs().max() <= 10 / 255
    write_tensors(tmp_path / "again.human", expanded(read_tensors(theirs)))
    assert torch.equal(load_human(tmp_path / "again.human").payload.rgb, payload.rgb)


def test_humans_on_other_bodies_are_left_to_the_backend(human, tmp_path):
    save_human(tmp_path / "a.human", human)
    tensors = read_tensors(tmp_path / "a.human")
    other = dataclasses.replace(tensors, metadata={**tensors.metadata, "body": "{}", "format_version": "2"})
    write_tensors(tmp_path / "b.human", other)
    assert opened(tmp_path / "b.human", tmp_path) is None


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
