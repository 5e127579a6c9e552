"""The textured, skinned mesh of a person, judged by what the marcher draws."""

import io
import sys

import numpy as np
import pytest
import torch
import trimesh
from export_people import SMALL, ball, person, proxy
from PIL import Image
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.export.proxy import (
    ARRAYS,
    OUTSIDE,
    TEXTURE,
    _march_inwards,
    mesh_proxy,
    skin_weights,
    write_proxy_arrays,
    write_proxy_glb,
)
from primdiffusion.export.simplify import simplify, unwrap
from primdiffusion.export.surface import OuterSurface, depth_below, outside_surface
from primdiffusion.human import framing, place, pose_body
from primdiffusion.primitives.anchors import anchor_skin_weights, default_anchors
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.render.merge import merge
from primdiffusion.runtime.failures import MissingPackageError
from support.errors import refused


def test_it_is_closed_and_as_fine_as_asked_for():
    mesh = trimesh.Trimesh(proxy().vertices, proxy().faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert len(proxy().faces) <= 4000
    assert proxy().texture.shape == (256, 256, 3)


def test_its_weights_are_four_joints_that_sum_to_one():
    weights = proxy().skin_weights
    assert np.abs(weights.sum(1) - 1).max() < 1e-6
    assert (weights > 0).sum(1).max() <= 4
    assert weights.min() >= 0


def test_each_hand_follows_its_own_arm():
    left = proxy().vertices[:, 0] > 0.65
    arm = [16, 18, 20, 22]
    assert proxy().skin_weights[left][:, arm].sum(1).min() > 0.99


def test_each_leg_follows_itself_though_boxes_of_the_other_reach_it():
    primitives, body = place(person()), default_body()
    joints = body.shape(torch.zeros(10)).joints.double().numpy()
    shin = (joints[4] + joints[7]) / 2 + np.array([[0.0, 0.0, 0.03], [0.01, 0.0, 0.03], [0.0, 0.01, 0.03]])
    found = skin_weights(
        primitives, OuterSurface(shin, np.array([[0, 1, 2]])), anchor_skin_weights(default_anchors(), body)
    )
    assert found[:, [1, 4, 7]].sum(1).min() > 0.99


def test_rays_inwards_see_what_the_marcher_draws():
    primitives = place(person())
    camera = framing(primitives, 23, 48, 48)
    drawn = march(primitives, camera, MarchSettings(step=0.001))
    full = drawn.alpha.reshape(-1) > 0.99
    origin, directions = camera.rays()
    rays = directions.reshape(-1, 3)[full]
    entered = drawn.depth.reshape(-1)[full, None] - OUTSIDE
    colour, alpha = _march_inwards(merge(primitives, points=1), (origin + entered * rays).numpy(), rays.numpy())
    straight = (drawn.rgb.reshape(-1, 3)[full] / drawn.alpha.reshape(-1)[full, None]).numpy()
    assert np.abs(colour - straight)[alpha > 0.99].mean() < 0.01
    assert (alpha > 0.99).mean() > 0.9


@pytest.mark.parametrize("raised", [0.0, -0.9])
def test_posed_it_looks_like_the_marched_person(raised):
    theta = torch.zeros(24, 3)
    theta[16, 2], theta[1, 0] = raised, raised * 0.5
    pose = BodyPose.from_axis_angle(theta.flatten())
    primitives = place(person(), pose)
    skinning = pose_body(person().betas, pose).skinning.double().numpy()
    camera = framing(primitives, 17, 160, 160)
    marched, drawn = march(primitives, camera), rasterise(proxy().mesh().posed(skinning), camera, 2)
    there, covered = marched.alpha.numpy() > 0.5, drawn.alpha > 0.5
    assert (there & covered).sum() / (there | covered).sum() > 0.93
    both = there & covered
    straight = marched.rgb.numpy() / np.maximum(marched.alpha.numpy(), 1e-6)[..., None]
    assert np.abs(straight - drawn.rgb / np.maximum(drawn.alpha, 1e-6)[..., None])[both].mean() < 0.04


def test_texels_between_charts_take_the_nearest_colour():
    assert proxy().texture.max(-1).min() > 60  # nothing is left black


def test_glb_is_read_by_trimesh_with_texture_and_the_same_surface(tmp_path):
    write_proxy_glb(tmp_path / "p.glb", proxy(), {"seed": 1})
    scene = trimesh.load(tmp_path / "p.glb")
    mesh = scene.geometry["person"]
    assert len(mesh.faces) == len(proxy().faces)
    standing = proxy().on_floor().vertices
    np.testing.assert_allclose(mesh.bounds, [standing.min(0), standing.max(0)], atol=1e-6)
    assert mesh.visual.material.baseColorTexture.size == (256, 256)
    assert list(tmp_path.iterdir()) == [tmp_path / "p.glb"]


def test_files_for_other_programs_have_the_soles_at_0(tmp_path):
    write_proxy_glb(tmp_path / "p.glb", proxy(), {})
    low, high = trimesh.load(tmp_path / "p.glb", force="mesh", process=False).bounds[:, 1]
    assert low == pytest.approx(0, abs=0.05)  # the surface is off the body's by clothes and voxels
    assert 1.5 < high < 2.0
    body = default_body().shape(torch.as_tensor(person().betas)).vertices[:, 1]
    assert low == pytest.approx(proxy().vertices[:, 1].min() - float(body.min()), abs=1e-5)


def test_the_skeleton_stands_where_its_mesh_does(tmp_path):
    there, standing = proxy(), proxy().on_floor()
    moved = standing.vertices - there.vertices
    assert np.abs(moved - moved[0]).max() < 1e-12
    np.testing.assert_allclose(standing.skeleton.positions - there.skeleton.positions, np.tile(moved[0], (24, 1)))


def test_arrays_for_blender_are_plain_and_complete(tmp_path):
    write_proxy_arrays(tmp_path, proxy())
    with np.load(tmp_path / ARRAYS, allow_pickle=False) as arrays:
        assert arrays["vertices"].shape == proxy().vertices.shape
        assert arrays["uv_corner"].shape == (len(proxy().faces), 3, 2)
        assert arrays["skin_weights"].shape == (len(proxy().vertices), 24)
        assert arrays["joints"].shape == (24, 3)
    picture = Image.open(io.BytesIO((tmp_path / TEXTURE).read_bytes()))
    assert np.array_equal(np.array(picture), proxy().texture)


def test_stages_are_reported_and_may_end_the_job():
    def stop(stage, _done, _total):
        raise InterruptedError(stage)

    with refused(InterruptedError, "surface"):
        mesh_proxy(person(), SMALL, stop)


def as_trimesh(surface):
    return trimesh.Trimesh(*surface, process=False)


def test_a_ball_is_closed_round_and_of_its_size():
    mesh = as_trimesh(simplify(*outside_surface(merge(ball(0.3), 0.02, points=1)), 3000))
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
        unwrap(np.zeros((3, 3)), np.array([[0, 1, 2]]), 64)
