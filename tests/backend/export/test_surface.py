"""The outside of boxes as closed triangles."""

import sys

import numpy as np
import pytest
import torch
import trimesh
from export_people import ball, person
from primdiffusion.export.simplify import simplified, unwrapped
from primdiffusion.export.surface import depth_below, outside_surface
from primdiffusion.human import place
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.merge import merge
from primdiffusion.runtime.failures import MissingPackageError
from support.errors import refused


def as_trimesh(surface):
    return trimesh.Trimesh(*surface, process=False)


def test_a_ball_is_closed_round_and_of_its_size():
    mesh = as_trimesh(simplified(*outside_surface(merge(ball(0.3), 0.02, points=1)), 3000))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert len(mesh.faces) <= 3000
    away = np.linalg.norm(mesh.vertices, axis=1)
    assert away.min() > 0.29
    assert away.max() < 0.34  # a density of 12 of 100 lies outside the middle of the slope


def test_faces_look_outwards():
    assert as_trimesh(outside_surface(merge(ball(), 0.02, points=1))).volume > 0.1


def test_invisible_matter_has_no_surface():
    shell = as_trimesh(outside_surface(merge(ball(0.3, hollow=0.15), 0.02, points=1)))
    full = as_trimesh(outside_surface(merge(ball(0.3), 0.02, points=1)))
    assert shell.body_count == 1
    assert shell.volume == pytest.approx(full.volume, rel=1e-6)


def test_crumbs_are_dropped_and_limbs_apart_are_kept():
    pieces = Primitives.together([ball(0.2), ball(0.06, centre=(1.2, 0.0, 0.0)), ball(0.1, centre=(-1.2, 0.0, 0.0))])
    small = ball(0.02, centre=(0.0, 1.2, 0.0))
    small = type(small)(**{**vars(small), "half_extent": torch.full((1, 3), 0.08)})  # a ball of a centimetre
    surface = outside_surface(merge(Primitives.together([pieces, small]), 0.01, points=1))
    assert as_trimesh(surface).body_count == 3
    assert surface.vertices[:, 1].max() < 0.5


def test_depth_is_measured_from_the_surface():
    points = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.45, 0, 0], [9.0, 0, 0]])
    depth = depth_below(merge(ball(0.3), 0.008, points=1), points)
    assert depth == pytest.approx([0.315, 0.115, 0, 0], abs=0.02)


def test_a_person_of_nothing_is_rejected_with_a_sentence():
    primitives = place(person())
    empty = type(primitives)(**{**vars(primitives), "density": torch.zeros_like(primitives.density)})
    with refused(ValueError):
        outside_surface(merge(empty, 0.02, points=1))


def test_without_xatlas_unwrapping_is_rejected_with_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with refused(MissingPackageError, "xatlas"):
        unwrapped(np.zeros((3, 3)), np.array([[0, 1, 2]]), 64)
