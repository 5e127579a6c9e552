"""What the baked body and base mesh promise to everybody who builds on them."""

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.people.base_mesh import load_base_mesh

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


def test_sizes_are_the_contracts():
    body = default_body()
    assert body.template.shape == (12196, 3)
    assert body.faces.shape == body.uv_faces.shape == (24300, 3)
    assert body.uv.shape == (13211, 2)
    assert body.shape_basis.shape == (12196, 3, 10)
    assert len(JOINT_NAMES) == J == 24


def test_every_array_is_its_own_mirror_image(twin):
    body = default_body()
    np.testing.assert_array_equal(body.shape_basis.numpy()[twin] * FLIP[:, None], body.shape_basis.numpy())
    np.testing.assert_array_equal(body.skin_weights.numpy()[twin][:, TWIN_JOINT], body.skin_weights.numpy())
    np.testing.assert_array_equal(body.joint_regressor.numpy()[TWIN_JOINT][:, twin], body.joint_regressor.numpy())


def test_mirrored_pose_gives_the_mirrored_body(twin):
    generator = torch.Generator().manual_seed(7)
    shaped = default_body().shape(torch.randn(10, generator=generator))
    vectors = 0.6 * torch.randn(J, 3, generator=generator)
    mirrored = vectors[TWIN_JOINT] * torch.tensor([1.0, -1.0, -1.0])
    posed, other = (shaped.pose(BodyPose.from_axis_angle(v.flatten())).vertices.numpy() for v in (vectors, mirrored))
    np.testing.assert_allclose(other, posed[twin] * FLIP, atol=3e-6)


def test_every_face_has_a_mirror_twin_with_the_opposite_turn(twin):
    def turned(face: np.ndarray) -> tuple[int, ...]:
        return tuple(np.roll(face, -int(face.argmin())))

    faces = default_body().faces.numpy()
    present = {turned(face) for face in faces}
    assert len(present) == len(faces)
    assert all(turned(twin[face[::-1]]) in present for face in faces)


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


def test_normals_point_outward():
    body = default_body()
    a, b, c = body.template[body.faces].double().unbind(1)
    volume = (a * torch.linalg.cross(b, c)).sum() / 6
    assert 0.05 < volume < 0.11  # cubic metres; people are about as heavy as water


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
