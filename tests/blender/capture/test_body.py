"""The body in numpy: the backend's, to rounding."""

import numpy as np
import pytest
import synthetic
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.joints import JOINT_NAMES
from support.errors import refused

from blender_primdiffusion.capture.body import fit_joints, read_body

pytestmark = pytest.mark.any_blender


@pytest.fixture(scope="module")
def body():
    return read_body()


def arrays(count: int = 30) -> dict[str, np.ndarray]:
    """A small body of SMPL's form with pose blend shapes."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(0, 1, (count, 24)) ** 8
    regressor = rng.uniform(0, 1, (24, count))
    parents = synthetic.PARENTS.astype(np.int64)
    return {
        "v_template": rng.normal(0, 0.3, (count, 3)),
        "shapedirs": rng.normal(0, 0.01, (count, 3, 12)),
        "posedirs": rng.normal(0, 0.01, (count, 3, 207)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "f": rng.integers(0, count, (20, 3)),
        "kintree_table": np.stack([np.where(parents < 0, 2**32 - 1, parents), np.arange(24)]),
    }


@pytest.mark.parametrize("seed", range(3))
def test_a_posed_body_is_the_backends(body, seed):
    torch = pytest.importorskip("torch")
    model = pytest.importorskip("primdiffusion.body.model")
    rng = np.random.default_rng(seed)
    betas, move = rng.normal(size=10), rng.normal(size=3)
    rotations = synthetic.axis_angle(rng.normal(0, 0.6, (24, 3)))
    vertices, joints, skinning = body.pose(betas, rotations, move)
    pose = model.BodyPose(torch.from_numpy(rotations), torch.from_numpy(move))
    twin = model.default_body().to(dtype=torch.float64, device="cpu").shape(torch.from_numpy(betas)).pose(pose)
    np.testing.assert_allclose(vertices, twin.vertices.numpy(), atol=1e-9)
    np.testing.assert_allclose(joints, twin.joints[:, :3, 3].numpy(), atol=1e-9)
    np.testing.assert_allclose(skinning, twin.skinning.numpy(), atol=1e-9)


def test_pose_blend_shapes_are_those_of_smplx(tmp_path):
    lbs = pytest.importorskip("smplx.lbs")
    torch = pytest.importorskip("torch")
    content = arrays()
    np.savez(tmp_path / "mine.npz", **content)
    body = read_body(tmp_path / "mine.npz")
    assert body.name == "mine"
    rng = np.random.default_rng(3)
    betas, theta = rng.normal(size=10), rng.normal(0, 0.5, (24, 3))
    vertices, joints, _ = body.pose(betas, synthetic.axis_angle(theta), np.zeros(3))

    def tensor(array):
        return torch.from_numpy(np.asarray(array, np.float64))

    posedirs = tensor(content["posedirs"].reshape(-1, 207).T)
    twin, twin_joints = lbs.lbs(
        tensor(betas)[None], tensor(theta).reshape(1, -1), tensor(content["v_template"])[None],
        tensor(content["shapedirs"][..., :10]), posedirs, tensor(content["J_regressor"]),
        torch.from_numpy(synthetic.PARENTS), tensor(content["weights"]),
    )  # fmt: skip
    np.testing.assert_allclose(vertices, twin[0].numpy(), atol=1e-6)  # smplx adds 1e-8 to angles
    np.testing.assert_allclose(joints, twin_joints[0].numpy(), atol=1e-6)


def test_betas_that_lack_are_zero_and_betas_too_many_are_rejected(body):
    few, _ = body.rest([1.0, -1.0])
    all_of_them, _ = body.rest([1.0, -1.0, *[0.0] * 30])
    np.testing.assert_array_equal(few, all_of_them)
    with refused(ValueError, "11 betas"):
        body.rest(np.ones(11))


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"weights": None}, "'weights'"),
        ({"v_template": np.full((30, 3), np.nan)}, "'v_template'"),
        ({"J_regressor": np.ones((55, 30))}, "'J_regressor'"),
        ({"f": np.full((20, 3), 30)}, "vertices"),
        ({"kintree_table": np.zeros((2, 24), np.int64)}, "24"),
        ({"shapedirs": np.array({"a": 1}, object)}, "pickled"),
    ],
)
def test_a_body_of_another_form_is_named(tmp_path, change, name):
    content = {key: value for key, value in (arrays() | change).items() if value is not None}
    np.savez(tmp_path / "body.npz", **content)
    with refused(FileError, name):
        read_body(tmp_path / "body.npz")


def rig_of(body, betas, off: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Joints of a rig whose bones begin about `off` metres from the joints of the body."""
    joints = body.rest(betas)[1]
    return dict(zip(JOINT_NAMES, joints + np.random.default_rng(seed).normal(0, off, joints.shape), strict=True))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("off", [0.0, 0.02, 0.04, 0.06])
def test_a_rig_of_the_size_of_a_body_keeps_its_size_however_badly_it_fits(body, seed, off):
    fit = fit_joints(body, rig_of(body, np.random.default_rng(seed + 9).normal(size=10), off, seed))
    assert fit.scale == 1.0
    assert np.abs(fit.betas).max() <= 4.0


@pytest.mark.parametrize(("size", "scale"), [(0.6, 1.25), (1.6, 0.8)])
def test_children_and_giants_are_brought_nearer_to_the_sizes_of_the_body(body, size, scale):
    joints = {name: size * place for name, place in rig_of(body, np.zeros(10), 0.0).items()}
    fit = fit_joints(body, joints)
    assert abs(fit.scale - scale) < 0.15
    assert np.abs(fit.betas).max() <= 4.0
