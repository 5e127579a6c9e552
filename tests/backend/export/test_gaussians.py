"""3D Gaussian files, drawn by a small splatter and compared with the marcher."""

import functools

import numpy as np
import pytest
import splatter
import torch
from export_people import person
from primdiffusion.body.model import BodyPose
from primdiffusion.export.gaussians import PROPERTIES, gaussians_of, write_gaussians
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import framing, place
from primdiffusion.render.march import march
from support.errors import refused


@functools.cache
def sparse():
    """Every eighth box: quick where only numbers matter."""
    return place(person()).map(lambda tensor: tensor[::8])


@functools.cache
def everything():
    return gaussians_of(place(person()), 10**6)


def drawn(ply, camera):
    picture, alpha = splatter.draw(ply, camera)
    return np.clip(picture + (1 - alpha[..., None]) * 0.5, 0, 1), alpha


def marched(primitives, camera):
    rendering = march(primitives, camera)
    alpha = rendering.alpha.numpy()
    straight = encode_srgb(np.clip(rendering.rgb.numpy() / np.maximum(alpha, 1e-6)[..., None], 0, 1))
    return straight * alpha[..., None] + (1 - alpha[..., None]) * 0.5, alpha


@pytest.mark.parametrize("bent", [pytest.param(0.0, marks=pytest.mark.slow), 0.8])
def test_splatted_they_look_like_the_marched_person(tmp_path, bent):
    theta = torch.zeros(24, 3)
    theta[1, 0] = -bent
    primitives = place(person(), BodyPose.from_axis_angle(theta.flatten()))
    write_gaussians(tmp_path / "p.ply", gaussians_of(primitives))
    camera = framing(primitives, 29, 288, 288)
    mine, alpha = drawn(splatter.read_ply(tmp_path / "p.ply"), camera)
    truth, opacity = marched(primitives, camera)
    somebody = (alpha > 0.5) | (opacity > 0.5)
    assert -10 * np.log10(((mine - truth) ** 2)[somebody].mean()) > 22
    assert np.abs(alpha - opacity).mean() < 0.02


def test_the_file_has_the_usual_layout(tmp_path):
    write_gaussians(tmp_path / "p.ply", gaussians_of(sparse(), 500))
    ply = splatter.read_ply(tmp_path / "p.ply")
    assert tuple(ply) == PROPERTIES
    assert len(ply["x"]) == 500
    turn = np.stack([ply[f"rot_{i}"] for i in range(4)], -1)
    np.testing.assert_allclose(np.linalg.norm(turn, axis=1), 1, atol=1e-6)
    assert np.isfinite(np.stack(list(ply.values()))).all()


def test_colours_are_stored_as_viewers_show_them(tmp_path):
    gaussians = gaussians_of(sparse(), 200)
    write_gaussians(tmp_path / "p.ply", gaussians)
    ply = splatter.read_ply(tmp_path / "p.ply")
    shown = 0.5 + splatter.C0 * np.stack([ply[f"f_dc_{i}"] for i in range(3)], -1)
    np.testing.assert_allclose(shown, encode_srgb(gaussians.rgb).numpy(), atol=1e-5)


def test_rotations_turn_local_axes_into_the_boxes_axes():
    primitives = sparse()
    found = gaussians_of(primitives).rotation.double()
    w, x, y, z = found[0]
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    boxes = primitives.rotation[:, :, 2].double()
    assert float((boxes @ axis).max()) > 1 - 1e-6


def test_a_limit_keeps_the_most_opaque_and_thins_hands_and_torso_alike():
    many, few = everything(), gaussians_of(place(person()), 3000)
    assert len(few.opacity) == 3000
    assert float(few.opacity.mean()) > float(many.opacity.mean())
    assert float(few.position[:, 0].max()) > float(many.position[:, 0].max()) - 0.1


def test_invisible_matter_is_left_out():
    primitives = place(person())
    assert len(everything().opacity) < 0.8 * float((primitives.density > 0).sum())


def test_a_limit_of_none_and_a_person_of_nothing_are_rejected():
    primitives = sparse()
    with refused(ValueError, "1 or more"):
        gaussians_of(primitives, 0)
    empty = type(primitives)(**{**vars(primitives), "density": torch.zeros_like(primitives.density)})
    with refused(ValueError, "enough"):
        gaussians_of(empty)
