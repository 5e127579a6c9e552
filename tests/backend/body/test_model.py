"""The body chain: against hand counts, symmetry, rigid motions, gradients, and the smplx package."""

import json
import math
import pickle

import numpy as np
import pytest
import smplx
import torch
from primdiffusion.body.model import (
    BodyModel,
    BodyPose,
    J,
    betas_of_measures,
    default_body,
    measure,
    read_pose,
)
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.people.base_mesh import load_base_mesh
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


FLIP = np.array([-1.0, 1.0, 1.0], np.float32)


TWIN_JOINT = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20, 23, 22]


@pytest.fixture(scope="module")
def twin() -> np.ndarray:
    template = default_body().template.numpy()
    number = {tuple(p): i for i, p in enumerate(template)}
    return np.array([number[tuple(p)] for p in template * FLIP + 0.0])


def height(betas: list[float]) -> float:
    vertices = default_body().shape(torch.tensor(betas)).vertices
    return float(vertices[:, 1].max() - vertices[:, 1].min())


def test_every_array_is_its_own_mirror_image(twin):
    body = default_body()
    np.testing.assert_array_equal(body.shape_basis.numpy()[twin] * FLIP[:, None], body.shape_basis.numpy())
    np.testing.assert_array_equal(body.skin_weights.numpy()[twin][:, TWIN_JOINT], body.skin_weights.numpy())
    np.testing.assert_array_equal(body.joint_regressor.numpy()[TWIN_JOINT][:, twin], body.joint_regressor.numpy())


def test_surface_is_an_oriented_manifold_with_few_openings():
    """Each directed edge is used once; the only open edges are the rims of eyes, mouth and nostrils."""
    faces = default_body().faces.numpy()
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = {tuple(edge) for edge in edges}
    assert len(directed) == len(edges)
    open_edges = np.array([edge for edge in directed if edge[::-1] not in directed])
    assert len(open_edges) < 200
    head = default_body().skin_weights[:, JOINT_NAMES.index("head")].numpy()
    assert head[np.unique(open_edges)].min() > 0.5


def test_skin_weights_are_weights_of_at_most_four_joints():
    weights = default_body().skin_weights
    assert (weights >= 0).all()
    assert ((weights > 0).sum(1) <= 4).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)), atol=1e-6, rtol=0)


def test_joint_regressor_rows_sum_to_one_and_sides_are_named_rightly():
    body = default_body()
    torch.testing.assert_close(body.joint_regressor.sum(1), torch.ones(J), atol=1e-5, rtol=0)
    joints = body.shape(torch.zeros(10)).joints
    torch.testing.assert_close(joints[0], torch.tensor([0.0, -0.22, 0.02]), atol=1e-4, rtol=0)
    for j, name in enumerate(JOINT_NAMES):
        if name.startswith(("left", "right")):
            assert joints[j, 0] * (1 if name.startswith("left") else -1) > 0.01, name
        else:
            assert abs(joints[j, 0]) < 1e-5, name


def test_joints_stay_inside_the_limbs_at_extreme_betas():
    body = default_body()
    for k in range(10):
        for sign in (-3.0, 3.0):
            betas = torch.zeros(10)
            betas[k] = sign
            shaped = body.shape(betas)
            knee = shaped.joints[JOINT_NAMES.index("left_knee")]
            near = shaped.vertices[(shaped.vertices[:, 1] - knee[1]).abs() < 0.02]
            leg = near[near[:, 0] > 0]
            assert (leg.min(0).values[[0, 2]] < knee[[0, 2]]).all()
            assert (leg.max(0).values[[0, 2]] > knee[[0, 2]]).all()


def test_first_beta_is_height_and_people_are_adults():
    assert height([-2.0]) < height([0.0]) < height([2.0])
    assert 1.70 < height([0.0]) < 1.82
    base = load_base_mesh()
    heights = [height(list(map(float, betas))) for betas in base.sample_betas[:60]]
    assert min(heights) > 1.45
    assert max(heights) < 2.05


def test_sample_betas_have_unit_spread_and_their_phenotypes_stand_beside_them():
    base = load_base_mesh()
    np.testing.assert_allclose(base.sample_betas.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(base.sample_betas.std(0), 1, atol=1e-5)
    tall = base.sample_phenotypes[:, base.phenotype_names.index("height")]
    assert np.corrcoef(tall, base.sample_betas[:, 0])[0, 1] > 0.8


def test_base_mesh_agrees_with_the_body_at_strong_betas():
    body, base = default_body(), load_base_mesh()
    visible = np.unique(base.faces)
    np.testing.assert_array_equal(base.faces, visible[body.faces.numpy()])
    betas = np.random.default_rng(0).normal(size=10) * 2
    theirs = body.shape(torch.tensor(betas, dtype=torch.float32)).vertices.numpy()
    assert np.linalg.norm(base.vertices(betas)[visible] - theirs, axis=1).max() < 3e-4
    dense = np.zeros((len(visible), J))
    np.add.at(dense, (np.arange(len(visible))[:, None], base.joint_index[visible]), base.joint_weight[visible])
    np.testing.assert_allclose(dense, body.skin_weights.numpy(), atol=1e-3)


def test_turning_back_to_the_native_pose_lowers_the_arms():
    base = load_base_mesh()
    arm = base.rest_from_native[JOINT_NAMES.index("left_shoulder")].T @ np.array([1.0, 0, 0])
    assert -70 < np.degrees(np.arctan2(arm[1], arm[0])) < -25
    np.testing.assert_allclose(
        base.rest_from_native @ base.rest_from_native.transpose(0, 2, 1), np.tile(np.eye(3), (J, 1, 1)), atol=1e-12
    )


THETA = np.linspace(-1, 1, 72).astype(np.float32)


def assert_same(pose: BodyPose, theta=THETA, translation=(0.0, 0.0, 0.0)):
    expected = BodyPose.from_axis_angle(torch.as_tensor(theta))
    assert torch.allclose(pose.joint_rotation, expected.joint_rotation, atol=1e-6)
    assert torch.allclose(pose.translation, torch.tensor(translation))


def test_a_list_of_72_rows_of_3_and_an_object_are_the_same_pose(tmp_path):
    for content in (THETA.tolist(), THETA.reshape(24, 3).tolist(), {"pose": THETA.tolist()}):
        path = tmp_path / "pose.json"
        path.write_text(json.dumps(content))
        assert_same(read_pose(path))


def test_a_translation_comes_along(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"pose": THETA.tolist(), "translation": [1, 2, 3]}))
    assert_same(read_pose(path), translation=(1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    "content", [[1, 2, 3], {"theta": None}, {"pose": "up"}, {}, [[0, 0, 0]] * 23, [math.nan] * 72, None, {"pose": []}]
)
def test_numbers_that_are_no_pose_are_rejected_by_name(content, tmp_path):
    path = tmp_path / "my pose.json"
    path.write_text(json.dumps(content))
    with refused(ValueError, "my pose"):
        read_pose(path)


def test_a_frame_beyond_the_end_is_rejected(tmp_path):
    path = tmp_path / "one.npz"
    np.savez(path, poses=np.zeros((2, 72)))
    with refused(ValueError, "one.npz"):
        read_pose(path, frame=2)


def test_a_person_is_as_tall_as_their_vertices_and_as_heavy_as_their_volume():
    import trimesh

    shape = default_body().shape(torch.tensor([0.5, -1.0, 0.3]))
    mesh = trimesh.Trimesh(shape.vertices.numpy(), default_body().faces.numpy(), process=False)
    height, weight = measure(shape)
    assert height == pytest.approx(mesh.extents[1], abs=1e-5)
    assert weight == pytest.approx(985 * mesh.volume, rel=1e-4)
    assert 1.5 < height < 2.1
    assert 40 < weight < 120


@pytest.mark.parametrize(("height", "weight"), [(1.6, None), (None, 80.0), (1.9, 95.0), (None, None)])
def test_bodies_of_given_measures_have_them(height, weight):
    betas = torch.linspace(-1, 1, 10)
    moved = betas_of_measures(betas, torch.eye(10), default_body(), height, weight)
    measured = measure(default_body().shape(moved))
    assert height is None or measured.height == pytest.approx(height, abs=2e-4)
    assert weight is None or measured.weight == pytest.approx(weight, abs=2e-2)
    assert (moved - betas).norm() < 5


def test_a_change_follows_the_shapes_that_people_have():
    # where only the first two betas vary, only they give way
    scale = torch.diag(torch.tensor([1.0, 1.0, *[0.0] * 8]))
    moved = betas_of_measures(torch.zeros(10), scale, default_body(), height=1.8, weight=75.0)
    assert torch.equal(moved[2:], torch.zeros(8))
    assert (moved[:2] != 0).all()


def test_bodies_that_no_human_has_are_rejected():
    with refused(ValueError, "2.60", "30 kg"):
        betas_of_measures(torch.zeros(10), torch.eye(10), default_body(), 2.6, 30.0)
