"""A person from noise to a picture, posed by numbers or as an armature moves it: joints' matrices and an object's."""

import dataclasses
import math

import pytest
import torch
from primdiffusion.body.model import BodyModel, BodyPose, default_body, measure, relative_rotations
from primdiffusion.formats.body_layout import LARGEST_STRETCH
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.rotation import axis_angle_to_matrix, polar
from primdiffusion.human import framing, generate, place, place_skinned, pose_body
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.primitives import K, Primitives
from primdiffusion.render.march import march
from support.errors import refused
from support.tiny import FULL_DENSITY, tiny_model


def bent(joint: int, angle: float) -> BodyPose:
    theta = torch.zeros(24, 3)
    theta[joint, 2] = angle
    return BodyPose.from_axis_angle(theta.flatten())


def test_a_seed_is_a_person(human):
    again, other = generate(tiny_model(), seed=3, steps=5), generate(tiny_model(), seed=4, steps=5)
    assert torch.equal(human.payload.rgb, again.payload.rgb)
    assert torch.equal(human.betas, again.betas)
    assert not torch.allclose(human.payload.rgb, other.payload.rgb)
    assert not torch.allclose(human.betas, other.betas)


def test_a_person_knows_where_it_comes_from(human):
    assert human.provenance["seed"] == 3
    assert human.provenance["steps"] == 5
    assert human.provenance["sampler"] == "dpmpp_2m"
    assert human.provenance["checkpoint"] == "tiny"
    assert human.provenance["full_density"] == FULL_DENSITY


def test_a_person_is_as_tall_and_heavy_and_dressed_as_asked_for():
    asked = {"outfit": "suit", "height": "1.9", "weight": 90.0}  # words of a command line will do
    person = generate(tiny_model(), seed=3, steps=3, attributes=asked, guidance=1.0)
    height, weight = measure(default_body().shape(person.betas))
    assert height == pytest.approx(1.9, abs=1e-3)
    assert weight == pytest.approx(90.0, abs=0.1)
    assert person.provenance["attributes"] == {"outfit": "suit", "height": 1.9, "weight": 90.0}
    assert person.provenance["guidance"] == 1.0
    anyone = generate(tiny_model(), seed=3, steps=3).provenance
    assert (anyone["guidance"], "attributes" in anyone) == (2.0, False), "it acts on what the seed chooses"
    jeans = generate(tiny_model(), seed=3, steps=3, attributes={"outfit": "jeans"}, guidance=1.0)
    assert not torch.allclose(person.payload.rgb, jeans.payload.rgb, atol=1e-4)
    with refused(ValueError, "guidance"):
        generate(tiny_model(), seed=3, steps=3, guidance=math.nan)


def test_every_step_is_seen_in_order_and_the_last_is_the_person():
    steps = []
    model = tiny_model()
    person = generate(model, seed=3, steps=5, on_step=steps.append)
    assert [(step.index, step.total) for step in steps] == [(i, 5) for i in range(5)]
    assert torch.equal(model.decode(steps[-1].x0).rgb[0], person.payload.rgb)


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"steps": 0}, {"steps": 1001}, {"sampler": "magic"}])
def test_settings_out_of_range_are_rejected(wrong):
    with refused(ValueError, *map(str, wrong.values())):
        generate(tiny_model(), **{"seed": 1, **wrong})


def test_without_a_pose_the_primitives_sit_on_the_t_pose(human):
    primitives = place(human)
    assert primitives.position.shape == (K, 3)
    posed = place(human, BodyPose.rest())
    assert torch.equal(primitives.position, posed.position)
    vertices = pose_body(human.betas).vertices
    distance = torch.cdist(primitives.position, vertices).amin(-1)
    assert distance.max() < 0.03, "anchors lie on the surface, at most an edge length from a vertex"


def test_frames_follow_the_posed_mesh_and_are_not_blended(human):
    """Bending the elbow by 90 degrees turns the frames of the forearm by it and leaves those of the legs alone."""
    anchors = default_anchors()
    rest, posed = place(human), place(human, bent(18, math.pi / 2))
    weights = default_body().skin_weights[default_body().faces[anchors.face, 0]]
    forearm = (weights[:, [18, 20, 22]].sum(-1) > 0.999) & (weights[:, 18] > 0.999)
    legs = weights[:, [1, 2, 4, 5, 7, 8, 10, 11]].sum(-1) > 0.999
    assert forearm.sum() > 5
    assert legs.sum() > 100
    assert torch.allclose(posed.position[legs], rest.position[legs], atol=1e-6)
    turn = posed.rotation @ rest.rotation.mT
    angle = torch.acos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    assert (angle[forearm].median() - math.pi / 2).abs() < 0.02
    identity = posed.rotation @ posed.rotation.mT
    assert torch.allclose(identity, torch.eye(3).expand_as(identity), atol=1e-5)


def test_moving_the_body_moves_the_primitives_rigidly(human):
    shift = torch.tensor([0.3, -1.0, 2.0])
    moved = place(human, dataclasses.replace(BodyPose.rest(), translation=shift))
    rest = place(human)
    assert torch.allclose(moved.position, rest.position + shift, atol=1e-6)
    assert torch.allclose(moved.rotation, rest.rotation, atol=1e-4)


def test_a_body_without_its_anchors_is_rejected(human):
    with refused(ValueError, "anchors"):
        place(human, body=default_body())


@pytest.mark.parametrize("yaw", [0, 40, 90, 180])
@pytest.mark.parametrize("size", [(64, 64), (40, 80), (96, 32)])
def test_the_framing_just_contains_the_person(human, yaw, size):
    primitives = place(human, bent(16, 1.0))
    camera = framing(primitives, yaw, *size)
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    offsets = (primitives.rotation[:, None] @ (primitives.half_extent[:, None] * signs)[..., None])[..., 0]
    pixels, depth = camera.project((primitives.position[:, None] + offsets).reshape(-1, 3))
    assert depth.min() > 0
    assert pixels.min() >= 0
    assert (pixels[:, 0] <= size[0]).all()
    assert (pixels[:, 1] <= size[1]).all()
    filled = (pixels.amax(0) - pixels.amin(0)) / torch.tensor(size)
    assert filled.max() > 0.8, "and wastes little of the picture"


def test_yaw_zero_looks_at_the_face_and_a_quarter_turn_at_the_persons_left(human):
    primitives = place(human)
    front, left = framing(primitives, 0.0).position, framing(primitives, yaw_degrees=90).position
    assert front[2] > 2
    assert front[0].abs() < 0.1
    assert left[0] > 2
    assert left[2].abs() < 0.1


def test_the_person_is_drawn_whole_and_opaque(human):
    boxes = place(human)
    rendering = march(boxes, framing(boxes, width=64, height=64))
    assert 0.1 < (rendering.alpha > 0.5).float().mean() < 0.5
    assert rendering.alpha[:, 32].max() > 0.99
    colour = rendering.rgb[rendering.alpha > 0.99].mean(0)
    assert torch.allclose(colour, human.payload.rgb.mean((0, 2, 3, 4)), atol=0.1)


def test_a_batch_or_a_wrong_number_is_no_human(human):
    batch = dataclasses.replace(human, payload=human.payload.map(lambda values: values[None]))
    with refused(ValueError, "batch"):
        batch.validate()
    broken = human.payload.rgb.clone()
    broken[5, 0, 0, 0, 0] = math.nan
    with refused(ValueError, "rgb"):
        dataclasses.replace(human, payload=dataclasses.replace(human.payload, rgb=broken)).validate()
    with refused(ValueError, "betas"):
        dataclasses.replace(human, betas=torch.tensor([math.inf] * 10)).validate()


STILL = torch.eye(3, 4)


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
