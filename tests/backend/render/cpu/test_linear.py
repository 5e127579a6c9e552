"""The stored derivative of a picture against the marcher's own gradients, and its products against each other."""

import numpy as np
import pytest
import torch
from march_scenes import camera_at, random_boxes
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu import linear as cpu_linear
from primdiffusion.render.cpu.linear import (
    VOXELS,
    ColourMatrix,
    PictureJacobian,
    add_colours_transposed,
    add_diagonal,
    add_transposed,
    apply,
    apply_colours,
    apply_to_codes,
    linearise,
)
from primdiffusion.render.cpu.march import march_cpu
from support.errors import refused

GREY = 0.2


@pytest.fixture(scope="module", params=[3.0, 150.0], ids=["thin", "saturating"])
def scene(request):
    """Boxes, camera, derivative and where alpha is free, of rays that stay clear or become opaque."""
    boxes = random_boxes(30, 3, density=request.param).to(dtype=torch.float32)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5, width=40, height=33).to(dtype=torch.float32)
    rendering, jacobian = linearise(boxes, camera, GREY)
    free = (rendering.alpha.numpy().ravel() < 1).astype(np.float32)
    assert (free < 1).any() == (request.param > 10)
    return boxes, camera, jacobian, free


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_transposed_product_is_the_gradient_that_the_marcher_has(scene):
    boxes, camera, jacobian, free = scene
    upstream = normal(1, jacobian.rays, 4)
    rgb, density = boxes.rgb.clone().requires_grad_(), boxes.density.clone().requires_grad_()
    picture = march_cpu(Primitives(boxes.position, boxes.rotation, boxes.half_extent, rgb, density), camera)
    over_grey = picture.rgb + (1 - picture.alpha[..., None]) * GREY
    fields = torch.cat([over_grey, picture.alpha[..., None]], dim=-1).flatten(0, 1)
    fields.backward(torch.from_numpy(upstream))
    expected = torch.cat([rgb.grad.movedim(1, -1).flatten(0, -2), density.grad.reshape(-1, 1)], dim=1).numpy()
    got = np.zeros_like(expected)
    add_transposed([jacobian], [upstream], [free], got)
    for column, name in ((slice(0, 3), "colour"), (slice(3, 4), "density")):
        difference = np.linalg.norm(got[:, column] - expected[:, column])
        assert difference < 0.02 * np.linalg.norm(expected[:, column]), name


def test_products_are_each_other_s_adjoint(scene):
    *_, jacobian, free = scene
    x, y = normal(2, jacobian.voxels, 4), normal(3, jacobian.rays, 4)
    back = np.zeros_like(x)
    add_transposed([jacobian], [y], [free], back)
    forward = (apply([jacobian], x, [free])[0].astype(np.float64) * y).sum()
    assert forward == pytest.approx(float((x.astype(np.float64) * back).sum()), rel=1e-3)


def test_diagonal_is_that_of_the_product(scene):
    *_, jacobian, free = scene
    weight = np.abs(normal(4, jacobian.rays, 4))
    diagonal = np.zeros((jacobian.voxels, 4), np.float32)
    add_diagonal(jacobian, weight, free, diagonal)
    for place in np.argsort(-diagonal.ravel())[:40:8]:
        unit = np.zeros_like(diagonal)
        unit.ravel()[place] = 1
        column = apply([jacobian], unit, [free])[0]
        assert diagonal.ravel()[place] == pytest.approx(float((weight * column**2).sum()), rel=1e-4)


def test_changes_given_by_codes_move_the_picture_as_the_voxels_that_they_stand_for(scene):
    *_, jacobian, free = scene
    boxes, codes, columns = jacobian.voxels // VOXELS, 5, 3
    slope, basis = normal(6, jacobian.voxels, 4), normal(7, 2, VOXELS, 4, codes)
    region, values = np.arange(boxes) % 2, normal(8, boxes, codes, columns)
    got = apply_to_codes(jacobian, slope, basis, region, values, free)
    changes = slope[..., None] * np.einsum("kvxc,kcn->kvxn", basis[region], values).reshape(-1, 4, columns)
    for column in range(columns):
        expected = apply([jacobian], np.ascontiguousarray(changes[..., column]), [free])[0]
        np.testing.assert_allclose(got[..., column], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


def test_colour_matrix_draws_the_picture(scene):
    boxes, camera, jacobian, _ = scene
    colours = boxes.rgb.movedim(1, -1).reshape(-1, 3).numpy()
    expected = march_cpu(boxes, camera).rgb.reshape(-1, 3).numpy()
    error = np.abs(apply_colours([ColourMatrix.of(jacobian)], np.ascontiguousarray(colours))[0] - expected)
    assert error.max() < 0.05
    assert error.mean() < 0.004


def test_colour_matrix_multiplies_every_column_alike(scene):
    *_, jacobian, _ = scene
    matrix, colours = ColourMatrix.of(jacobian), normal(5, jacobian.voxels, 6)
    together = apply_colours([matrix], colours)[0]
    alone = apply_colours([matrix], np.ascontiguousarray(colours[:, 2:5]))[0]
    np.testing.assert_allclose(together[:, 2:5], alone, rtol=1e-5, atol=1e-6)
    back = np.zeros_like(colours)
    add_colours_transposed([matrix], [together], back)
    assert float((colours * back).sum()) == pytest.approx(float((together**2).sum()), rel=1e-3)


def test_parts_make_the_same_matrix_as_the_whole(scene, monkeypatch):
    boxes, camera, jacobian, free = scene
    change = normal(4, jacobian.voxels, 4)
    drawn = apply([jacobian], change, [free])[0]
    monkeypatch.setattr(cpu_linear, "PARTS", 1)
    _, whole = linearise(boxes, camera, GREY)
    for name, part, wanted in zip(PictureJacobian._fields, jacobian, whole, strict=True):
        assert np.array_equal(part, wanted), name
    assert np.allclose(drawn, apply([whole], change, [free])[0], atol=1e-4)


def test_room_grows_with_the_matrix(scene, monkeypatch):
    boxes, camera, jacobian, _ = scene
    monkeypatch.setattr(cpu_linear, "FIRST_ROOM", 512)
    monkeypatch.setattr(cpu_linear, "ROOM_PER_PIXEL", 0)
    _, again = linearise(boxes, camera, GREY)
    for field in PictureJacobian._fields:
        assert np.array_equal(getattr(again, field), getattr(jacobian, field)), field


def test_other_boxes_are_named():
    boxes = random_boxes(2, size=4).to(dtype=torch.float32)
    with refused(ValueError, "8^3"):
        linearise(boxes, camera_at((0.0, 0.0, 0.6)).to(dtype=torch.float32), GREY)
    assert VOXELS == 512
