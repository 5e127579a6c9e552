"""Humans, solid objects and background on the GPU are composited as the child composites them."""

import dataclasses

import numpy as np
import pytest
from engine_stage import STEP
from gpu_stage import boxes_of, pinhole, placed, read

from blender_primdiffusion.engine.gpu.picture import GpuPicture, GpuScene, GpuSolids
from blender_primdiffusion.engine.gpu.refine import SAMPLES, jittered
from blender_primdiffusion.engine.picture import SceneSolids
from blender_primdiffusion.engine.view import view_from_matrices
from blender_primdiffusion.scene.convention import BLENDER_FROM_BACKEND

STEP_OF_8_BIT = 1 / 255


def box(middle, offset, half, colour, holdout=False) -> SceneSolids:
    """Twelve triangles."""
    centre = middle + np.float32(offset)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) * half + centre
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([corners[[a, b, c]] for q in quads for a, b, c in (q[:3], (q[0], *q[2:]))], np.float32)
    return SceneSolids(triangles, np.tile(np.float32(colour), (12, 1)), np.full(12, holdout))


def together(*parts: SceneSolids) -> SceneSolids:
    fields = (dataclasses.astuple(part) for part in parts)
    return SceneSolids(*(np.concatenate(column) for column in zip(*fields, strict=True)))


@pytest.fixture(scope="module")
def scene(backend, payload):
    """A human with one box before the chest, one around the legs and a holdout before the head."""
    fields = placed(backend)
    middle = fields["position"].mean(0)
    solids = together(
        box(middle, [0.1, 0.2, 0.5], 0.1, (0.8, 0.1, 0.1)),
        box(middle, [0.0, -0.7, 0.0], 0.2, (0.1, 0.2, 0.8)),
        box(middle, [0.0, 0.55, 0.4], 0.08, (1, 1, 1), holdout=True),
    )
    return payload, fields, solids, middle


def child(backend, scene, view, background) -> np.ndarray:
    _, fields, solids, _ = scene
    camera = {"intrinsics": view.intrinsics.tolist(), "world_to_camera": view.world_to_camera.tolist()}
    camera |= {"width": view.width, "height": view.height, "clip": view.clip}
    arrays = {name: values.tolist() for name, values in vars(solids).items()}
    out = str(backend.folder / "composed.npz")
    people = [{"boxes": fields["file"]}]
    backend.oracle.ask(
        {"compose": {"people": people, "solids": arrays, "background": background, **camera}, "out": out}
    )
    with np.load(out) as answer:
        return answer["combined"]


def composed(marcher, scene, view, background, samples=1) -> np.ndarray:
    payload, fields, solids, _ = scene
    content, mean = GpuScene([(payload, boxes_of(fields))], GpuSolids(solids), background, STEP), None
    for sample in range(samples):
        picture = GpuPicture(marcher, content, jittered(view, sample))
        assert picture.advance()
        mean = picture.compose(mean, sample)
    return read(mean, view)


@pytest.mark.parametrize("background", [None, (0.2, 0.3, 0.4)])
def test_solids_hide_humans_and_are_seen_behind_them(marcher, backend, scene, background):
    view = pinhole(scene[3], (0.6, 0.3, 4.0), size=(80, 120))
    wanted, shown = child(backend, scene, view, background), composed(marcher, scene, view, background)
    error = np.abs(shown - wanted).max(-1)
    assert np.quantile(error, 0.9) <= STEP_OF_8_BIT  # the rest are outlines of solids, which the child antialiases
    averaged = np.abs(composed(marcher, scene, view, background, SAMPLES) - wanted).max(-1)
    assert averaged[error > 0.1].mean() < 0.7 * error[error > 0.1].mean()  # its edges have two steps, these eight


def test_parallel_views_have_solids_at_the_same_place(marcher, backend, scene):
    middle = scene[3]
    to_view = np.eye(4)
    to_view[:3, :3] = BLENDER_FROM_BACKEND.T
    to_view[:3, 3] = [0, -middle[1], -5.0]
    subject = BLENDER_FROM_BACKEND @ middle
    view = view_from_matrices(np.diag([1.2, 0.8, -0.001, 1.0]), to_view, (-50.0, 50.0), (80, 120), subject)
    error = np.abs(composed(marcher, scene, view, None) - child(backend, scene, view, None)).max(-1)
    assert np.quantile(error, 0.9) <= STEP_OF_8_BIT
