"""A person as an armature moves it: joints' matrices and an object's, instead of a pose."""

import dataclasses
import math

import pytest
import torch
from primdiffusion.body.model import BodyModel, BodyPose, default_body, relative_rotations
from primdiffusion.formats.body_layout import LARGEST_STRETCH
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.rotation import axis_angle_to_matrix, polar
from primdiffusion.human import Human, generate, place, place_skinned, pose_body
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import march
from support.errors import refused
from support.tiny import tiny_model

STILL = torch.eye(3, 4)


@pytest.fixture(scope="module")
def human() -> Human:
    return generate(tiny_model(), seed=3, steps=5)


@pytest.fixture(scope="module")
def pose() -> BodyPose:
    g = torch.Generator().manual_seed(5)
    return BodyPose.from_axis_angle(0.4 * torch.randn(72, generator=g), torch.tensor([0.2, -0.1, 0.4]))


@pytest.fixture(scope="module")
def joints(human, pose) -> torch.Tensor:
    return pose_body(human.betas, pose).skinning[:, :3]


def object_matrix(linear: torch.Tensor, translation: tuple[float, ...] = (0.0, 0.0, 0.0)) -> torch.Tensor:
    return torch.cat([linear, torch.tensor(translation)[:, None]], -1)


def with_correctives(body: BodyModel) -> BodyModel:
    g = torch.Generator().manual_seed(1)
    basis = 0.01 * torch.randn(len(body.template), 3, 207, generator=g, dtype=body.template.dtype)
    return dataclasses.replace(body, pose_basis=basis)


def assert_equal_frames(got: Primitives, want: Primitives, metres: float = 1e-6, turn: float = 1e-5) -> None:
    assert (got.position - want.position).abs().max() < metres
    assert (got.rotation - want.rotation).abs().max() < turn
    assert torch.allclose(got.half_extent, want.half_extent, rtol=1e-5, atol=0)


def test_the_matrices_of_a_pose_place_a_person_as_the_pose_does(human, pose, joints):
    assert_equal_frames(place_skinned(human, joints, STILL), place(human, pose))
    posed = place_skinned(human, joints, STILL)
    assert posed.rgb is human.payload.rgb, "what fills the boxes is not copied"
    assert posed.density is human.payload.density


def test_the_same_with_pose_dependent_correctives(human, pose):
    body, anchors = with_correctives(default_body()), default_anchors()
    skinning = pose_body(human.betas, pose, body).skinning
    with_them = place_skinned(human, skinning, torch.eye(4), body, anchors)
    assert_equal_frames(with_them, place(human, pose, body, anchors), 5e-6, 5e-4)
    precise = human.to(dtype=torch.float64), pose.to(dtype=torch.float64)
    body, anchors = body.to(dtype=torch.float64), anchors.to(dtype=torch.float64)
    skinning = pose_body(precise[0].betas, precise[1], body).skinning
    got = place_skinned(precise[0], skinning, torch.eye(4).double(), body, anchors)
    assert_equal_frames(got, place(*precise, body, anchors), 1e-7, 1e-5)  # the pose is of float32
    assert (got.position - place(human, pose).position).abs().max() > 1e-3, "the correctives do something"


def test_relative_rotations_are_the_poses_whatever_scale_the_joints_carry(human, pose, joints):
    parents = default_body().parents.tolist()
    assert torch.allclose(relative_rotations(joints, parents), pose.joint_rotation, atol=1e-5)
    grown = torch.linspace(0.5, 2, 24)[:, None, None] * joints
    assert torch.allclose(relative_rotations(grown, parents), pose.joint_rotation, atol=1e-5)


def test_an_object_that_moves_and_turns_moves_and_turns_every_box(human, joints):
    turn = axis_angle_to_matrix(torch.tensor([0.3, 2.0, -0.4]))
    still = place_skinned(human, joints, STILL)
    moved = place_skinned(human, joints, object_matrix(turn, (3.0, -1.0, 0.5)))
    want = dataclasses.replace(
        still, position=still.position @ turn.T + torch.tensor([3.0, -1.0, 0.5]), rotation=turn @ still.rotation
    )
    assert_equal_frames(moved, want, 2e-6)


@pytest.mark.parametrize("scale", [0.1, 2.5])
def test_a_scaled_person_is_as_opaque_as_before(human, joints, scale):
    still = place_skinned(human, joints, STILL)
    scaled = place_skinned(human, joints, object_matrix(scale * torch.eye(3)))
    assert torch.allclose(scaled.position, scale * still.position, atol=1e-6 * max(scale, 1))
    assert torch.allclose(scaled.half_extent, scale * still.half_extent, rtol=1e-5)
    assert torch.allclose(scaled.density * scale, still.density, rtol=1e-5)
    assert torch.allclose(scaled.rotation, still.rotation, atol=2e-5)


def camera_in_front(mirrored: bool = False) -> Camera:
    """A camera on the plane x = 0, whose picture shows x and -x at the same distance from its middle."""
    eye = torch.tensor([0.0, 0.1, 3.5])
    return look_at(eye, eye * torch.tensor([1.0, 1.0, 0.0]), vertical_fov=0.6, width=65, height=64)


def test_a_mirrored_person_gives_the_mirrored_picture(human, joints):
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    still, mirrored = place_skinned(human, joints, STILL), place_skinned(human, joints, object_matrix(mirror))
    assert torch.allclose(torch.linalg.det(mirrored.rotation), -torch.ones(1024), atol=1e-4)
    picture, other = march(still, camera_in_front()), march(mirrored, camera_in_front())
    assert picture.alpha.mean() > 0.02
    assert not torch.allclose(picture.alpha, picture.alpha.flip(1), atol=0.1), "the pose is no mirror image of itself"
    assert torch.allclose(other.rgb, picture.rgb.flip(1), atol=2e-4)
    assert torch.allclose(other.alpha, picture.alpha.flip(1), atol=2e-4)


def test_a_person_stretched_along_the_world_keeps_its_boxes_on_the_stretched_body(human, joints):
    stretch = torch.diag(torch.tensor([1.0, 2.0, 0.5]))
    still, stretched = place_skinned(human, joints, STILL), place_skinned(human, joints, object_matrix(stretch))
    assert torch.allclose(stretched.position, still.position @ stretch, atol=2e-6)
    growth = stretched.half_extent / still.half_extent
    assert torch.allclose(growth[:, 2], torch.ones(1024), rtol=1e-5)
    assert growth.min() > 0.6
    assert growth.max() == pytest.approx(LARGEST_STRETCH, rel=1e-4), "boxes do not come apart"
    identity = stretched.rotation @ stretched.rotation.mT
    assert torch.allclose(identity, torch.eye(3).expand_as(identity), atol=1e-5)
    normals = torch.nn.functional.normalize(still.rotation[..., 2] @ torch.linalg.inv(stretch), dim=-1)
    assert ((normals * stretched.rotation[..., 2]).sum(-1) > 1 - 1e-5).all()


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_matrices_that_are_not_finite_are_rejected_by_name(human, joints, wrong):
    broken = joints.clone()
    broken[3, 1, 2] = wrong
    with refused(ValueError, "skinning", "NaN"):
        place_skinned(human, broken, STILL)
    still = STILL.clone()
    still[0, 0] = wrong
    with refused(ValueError, "object_to_world", "NaN"):
        place_skinned(human, joints, still)


def test_a_flat_object_is_rejected(human, joints):
    with refused(ValueError, "scale"):
        place_skinned(human, joints, object_matrix(torch.diag(torch.tensor([1.0, 1.0, 0.0]))))


@pytest.mark.parametrize("seed", range(5))
def test_polar_factors_are_orthogonal_and_symmetric_and_multiply_to_the_matrix(seed):
    matrix = torch.randn(7, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    orthogonal, stretch = polar(matrix)
    assert torch.allclose(orthogonal @ stretch, matrix, atol=1e-12)
    assert torch.allclose(orthogonal @ orthogonal.mT, torch.eye(3).double().expand(7, 3, 3), atol=1e-12)
    assert torch.allclose(stretch, stretch.mT, atol=1e-12)
    assert (torch.linalg.eigvalsh(stretch) > 0).all()
    assert torch.equal(torch.linalg.det(orthogonal).sign(), torch.linalg.det(matrix).sign())


def test_a_flat_joint_is_rejected_by_name(human, joints):
    flat = joints.clone()
    flat[4, :, :3] = 0
    with refused(ValueError, "left_knee"):
        place_skinned(human, flat, STILL)
