"""The body chain: against hand counts, symmetry, rigid motions, gradients, and the smplx package."""

import pickle

import numpy as np
import smplx
import torch
from primdiffusion.body.model import BodyModel, BodyPose, J, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from smplx.lbs import lbs
from support.errors import refused


def small_body(vertex_count: int = 40, dtype: torch.dtype = torch.float64) -> BodyModel:
    """Random numbers in a body's shape, with pose blend shapes."""
    g = torch.Generator().manual_seed(3)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=dtype)

    parents = torch.tensor([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
    weights, regressor = random(vertex_count, J), random(J, vertex_count)
    return BodyModel(
        template=random(vertex_count, 3) - 0.5,
        shape_basis=0.1 * random(vertex_count, 3, 6),
        pose_basis=0.05 * (random(vertex_count, 3, 207) - 0.5),
        joint_regressor=regressor / regressor.sum(1, keepdim=True),
        skin_weights=weights / weights.sum(1, keepdim=True),
        parents=parents,
        faces=torch.randint(vertex_count, (12, 3), generator=g),
        uv=random(9, 2),
        uv_faces=torch.randint(9, (12, 3), generator=g),
    )


def random_people(count: int, seed: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, ...]:
    g = torch.Generator().manual_seed(seed)
    betas = torch.randn(count, 10, generator=g, dtype=dtype)
    theta = 0.6 * torch.randn(count, 72, generator=g, dtype=dtype)
    return betas, theta, torch.randn(count, 3, generator=g, dtype=dtype)


def test_agrees_with_smplx_on_the_default_body(tmp_path):
    body = default_body()
    parents = body.parents.numpy().astype(np.uint32)
    file = {
        "v_template": body.template.numpy(),
        "shapedirs": body.shape_basis.numpy(),
        "posedirs": np.zeros((len(body.template), 3, 207)),
        "J_regressor": body.joint_regressor.numpy(),
        "weights": body.skin_weights.numpy(),
        "kintree_table": np.stack([parents, np.arange(J, dtype=np.uint32)]),
        "f": body.faces.numpy(),
    }
    (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(file))
    oracle = smplx.SMPL(str(tmp_path / "SMPL_NEUTRAL.pkl"), batch_size=3)
    betas, theta, translation = random_people(3, seed=1)
    expected = oracle(betas=betas, body_pose=theta[:, 3:], global_orient=theta[:, :3], transl=translation)
    posed = body.shape(betas).pose(BodyPose.from_axis_angle(theta, translation))
    torch.testing.assert_close(posed.vertices, expected.vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(posed.joints[..., :3, 3], expected.joints[:, :J], atol=1e-5, rtol=0)


def test_pose_blend_shapes_agree_with_smplx():
    body = small_body()
    betas, theta, _ = random_people(4, seed=2, dtype=torch.float64)
    posed = body.shape(betas[:, :6]).pose(BodyPose.from_axis_angle(theta))
    vertices, joints = lbs(
        betas[:, :6], theta, body.template[None], body.shape_basis, body.pose_basis.reshape(-1, 207).T,
        body.joint_regressor, body.parents, body.skin_weights,
    )  # fmt: skip
    torch.testing.assert_close(posed.vertices, vertices, atol=1e-6, rtol=0)  # smplx adds 1e-8 to angle vectors
    torch.testing.assert_close(posed.joints[..., :3, 3], joints, atol=1e-6, rtol=0)
    unblended = body.map(lambda t: torch.zeros_like(t) if t is body.pose_basis else t)
    without = unblended.shape(betas[:, :6]).pose(BodyPose.from_axis_angle(theta))
    assert (posed.vertices - without.vertices).abs().max() > 0.01


def test_rest_pose_returns_the_shaped_body():
    shaped = default_body().shape(torch.randn(10, generator=torch.Generator().manual_seed(0)))
    posed = shaped.pose(BodyPose.rest())
    torch.testing.assert_close(posed.vertices, shaped.vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(posed.joints[:, :3, 3], shaped.joints, atol=1e-6, rtol=0)


def test_bending_an_elbow_turns_the_hand_by_hand_count():
    body = default_body()
    theta = torch.zeros(J, 3)
    theta[JOINT_NAMES.index("left_elbow")] = torch.tensor([0.0, 0.0, torch.pi / 2])
    shaped = body.shape(torch.zeros(10))
    posed = shaped.pose(BodyPose.from_axis_angle(theta.flatten()))
    elbow, wrist = (JOINT_NAMES.index(f"left_{n}") for n in ("elbow", "wrist"))
    dx, dy, dz = shaped.joints[wrist] - shaped.joints[elbow]
    moved = posed.joints[wrist, :3, 3] - posed.joints[elbow, :3, 3]
    torch.testing.assert_close(moved, torch.stack([-dy, dx, dz]), atol=1e-6, rtol=0)
    still = body.skin_weights[:, [elbow, wrist, JOINT_NAMES.index("left_hand")]].sum(1) == 0
    torch.testing.assert_close(posed.vertices[still], shaped.vertices[still], atol=1e-6, rtol=0)


def test_turning_the_pelvis_turns_the_whole_body_rigidly():
    betas, theta, translation = random_people(1, seed=5)
    shaped = default_body().shape(betas[0])
    pose = BodyPose.from_axis_angle(theta[0], translation[0])
    turn = axis_angle_to_matrix(torch.tensor([0.3, -1.1, 0.4]))
    turned_rotation = torch.cat([(turn @ pose.joint_rotation[:1]), pose.joint_rotation[1:]])
    pelvis = shaped.joints[0]
    moved_pelvis = turn @ (pelvis + translation[0])
    turned = shaped.pose(BodyPose(turned_rotation, moved_pelvis - pelvis))
    torch.testing.assert_close(turned.vertices, shaped.pose(pose).vertices @ turn.T, atol=2e-6, rtol=0)


def test_batches_of_bodies_and_poses_broadcast():
    body = small_body()
    betas, theta, translation = random_people(6, seed=9, dtype=torch.float64)
    betas = betas[:, :6]
    crossed = body.shape(betas[:2, None]).pose(
        BodyPose.from_axis_angle(theta[:3], translation[:3]).map(lambda t: t[None].expand(2, *t.shape))
    )
    alone = body.shape(betas[1]).pose(BodyPose.from_axis_angle(theta[2], translation[2]))
    assert crossed.vertices.shape == (2, 3, len(body.template), 3)
    torch.testing.assert_close(crossed.vertices[1, 2], alone.vertices)
    many_poses = body.shape(betas[1]).pose(BodyPose.from_axis_angle(theta, translation))
    torch.testing.assert_close(many_poses.vertices[2], alone.vertices)
    assert body.shape(betas).pose(BodyPose.rest(dtype=torch.float64)).vertices.shape[0] == 6


def test_gradients_are_those_of_the_function():
    body = small_body(5)
    betas, theta, translation = (t.requires_grad_() for t in random_people(1, seed=11, dtype=torch.float64))

    def posed(betas: torch.Tensor, theta: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
        return body.shape(betas[:, :6]).pose(BodyPose.from_axis_angle(theta, translation)).vertices

    assert torch.autograd.gradcheck(posed, (betas, theta, translation))
    at_rest = torch.zeros(1, 72, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda theta: posed(betas.detach(), theta, translation.detach()), at_rest)


def test_fewer_betas_count_as_zeros_and_more_are_rejected():
    body = small_body()
    padded = torch.tensor([0.5, -1.0, 0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(body.shape(padded[:2]).vertices, body.shape(padded).vertices)
    with refused(ValueError, "7 betas"):
        body.shape(torch.zeros(7, dtype=torch.float64))


def test_poses_with_hand_joints_are_rejected_with_advice():
    with refused(ValueError, "72 numbers", "(2, 156)"):
        BodyPose.from_axis_angle(torch.zeros(2, 156))
