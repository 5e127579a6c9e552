"""Shape in the extension is shape in the backend: surface, joints, frames, measures, on the default body."""

from itertools import pairwise

import numpy as np
import pytest
from support.errors import refused

pytest.importorskip("torch", reason="the backend has another Python than this Blender")

import torch
from primdiffusion.body.model import betas_of_measures as backend_betas_of_measures
from primdiffusion.body.model import default_body
from primdiffusion.body.model import measure as backend_measure
from primdiffusion.editing.reshaping import box_growth
from primdiffusion.primitives.anchors import attach, default_anchors

from blender_primdiffusion.scene.human_file import default_body as default_body_here
from blender_primdiffusion.scene.shape import betas_of_measures, measure, slider_names

pytestmark = pytest.mark.any_blender

SHAPES = np.random.default_rng(4).normal(0, 1.2, (4, 10))


@pytest.fixture(scope="module")
def model():
    return default_body_here()


@pytest.mark.parametrize("betas", SHAPES)
def test_surface_and_joints_are_the_backends_to_a_hundredth_of_a_millimetre(model, betas):
    shaped, rest = default_body().shape(torch.tensor(betas, dtype=torch.float32)), model.rest(betas)
    np.testing.assert_allclose(rest.vertices, shaped.vertices, atol=2e-6)
    np.testing.assert_allclose(rest.joints, shaped.joints, atol=5e-6)


@pytest.mark.parametrize("betas", SHAPES)
def test_frames_are_the_backends(model, betas):
    body = default_body().to(dtype=torch.float64)
    anchors = default_anchors().to(dtype=torch.float64)
    wanted = attach(anchors, body.shape(torch.tensor(betas)).vertices, body.faces)
    rest = model.rest(betas)
    np.testing.assert_allclose(rest.position, wanted.position, atol=1e-6)
    np.testing.assert_allclose(rest.rotation, wanted.rotation, atol=1e-5)


def test_frames_on_a_posed_surface_in_blenders_axes_are_the_backends_turned(model):
    body = default_body()
    vertices = body.shape(torch.tensor(SHAPES[0], dtype=torch.float32)).vertices
    vertices = vertices + 0.02 * torch.sin(9 * vertices.flip(-1))
    wanted = attach(default_anchors().to(dtype=torch.float64), vertices.double(), body.faces)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    position, rotation = model.frames(vertices.double().numpy() @ turn.T)
    np.testing.assert_allclose(position, wanted.position.numpy() @ turn.T, atol=1e-6)
    np.testing.assert_allclose(rotation, turn @ wanted.rotation.numpy(), atol=1e-5)


def test_boxes_grow_as_the_backends(model):
    body, anchors = default_body().to(dtype=torch.float64), default_anchors().to(dtype=torch.float64)
    for before, after in pairwise(SHAPES):
        wanted = box_growth(body, anchors, torch.tensor(before), torch.tensor(after))
        assert wanted.max() > 1.1
        np.testing.assert_allclose(model.growth(before, after), wanted, rtol=1e-5)
    assert (model.growth(SHAPES[0], SHAPES[0]) == 1).all()


@pytest.mark.parametrize("betas", SHAPES)
def test_height_and_weight_are_the_backends(model, betas):
    wanted = backend_measure(default_body().shape(torch.tensor(betas, dtype=torch.float32)))
    assert measure(model, betas) == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize(("height", "weight"), [(1.6, None), (None, 80.0), (1.9, 95.0), (None, None)])
def test_bodies_of_given_measures_are_the_backends(model, height, weight):
    wanted = backend_betas_of_measures(
        torch.tensor(SHAPES[1]), torch.eye(10, dtype=torch.float64), default_body(), height, weight
    )
    moved = betas_of_measures(model, SHAPES[1], height, weight)
    np.testing.assert_allclose(moved, wanted, atol=5e-3)
    measured = measure(model, moved)
    assert height is None or measured.height == pytest.approx(height, abs=1e-4)
    assert weight is None or measured.weight == pytest.approx(weight, abs=1e-2)


def test_impossible_measures_are_rejected_and_named(model):
    with refused(ValueError, "3.00", "40 kg"):
        betas_of_measures(model, np.zeros(10), 3.0, 40.0)


def test_the_persons_own_body_is_left_in_peace(model):
    betas = SHAPES[2].copy()
    betas_of_measures(model, betas, 1.8)
    np.testing.assert_array_equal(betas, SHAPES[2])


def change(model, slider: str, measured) -> float:
    """What two standard deviations of a slider change in what is measured of the body."""
    betas = 2.0 * (np.array(slider_names(model)) == slider)
    assert betas.sum() == 2.0
    return measured(betas) - measured(-betas)


def waist(model, betas: np.ndarray) -> float:
    """Width [m] of the torso at 62 % of the height."""
    x, y, _ = model.surface(betas).T
    share = (y - y.min()) / np.ptp(y)
    return np.ptp(x[(share > 0.60) & (share < 0.64) & (np.abs(x) < 0.3)])


def test_named_sliders_of_the_default_body_do_what_they_are_called(model):
    height, weight = (lambda betas, row=row: measure(model, betas)[row] for row in range(2))
    assert change(model, "Stature", height) > 0.5
    left, right = 16, 17
    assert change(model, "Shoulders", lambda betas: np.subtract(*model.rest(betas).joints[[left, right], 0])) > 0.05
    assert change(model, "Waist", lambda betas: waist(model, betas)) > 0.05
    assert abs(change(model, "Waist", height)) < 0.01
    assert change(model, "Girth", weight) > 15
    assert abs(change(model, "Girth", height)) < 0.01
