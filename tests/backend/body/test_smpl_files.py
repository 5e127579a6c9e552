"""Users' own body files: pickles as SMPL ships them, npz, texture coordinates beside them, and broken files."""

import dataclasses
import pathlib
import pickle
import pickletools
import sys
import types

import numpy as np
import pytest
import scipy.sparse
import torch
from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.body.smpl_files import load_body
from primdiffusion.files.regular_files import FileError
from smplx.lbs import lbs
from support.errors import refused

V, F = 60, 116
PARENTS = [2**32 - 1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


def smpl_arrays() -> dict[str, object]:
    """A closed tube of 60 vertices with everything an SMPL file holds, in its types."""
    rng = np.random.default_rng(0)
    ring, step = np.divmod(np.arange(V - 4), 4)
    template = np.stack([np.cos(step * np.pi / 2), ring * 0.2, np.sin(step * np.pi / 2)], 1)
    template = np.concatenate([template, rng.normal(size=(4, 3)) + np.array([0, 5, 0])])
    faces = np.stack([rng.permutation(V)[:3] for _ in range(F)])
    weights = rng.random((V, J)) ** 4
    regressor = rng.random((J, V)) * (rng.random((J, V)) < 0.3)
    regressor[:, 0] += 0.1
    return {
        "v_template": template,
        "f": faces.astype(np.uint32),
        "shapedirs": 0.1 * rng.normal(size=(V, 3, 300)),
        "posedirs": 0.02 * rng.normal(size=(V, 3, 207)),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": scipy.sparse.csc_matrix(regressor / regressor.sum(1, keepdims=True)),
        "kintree_table": np.array([PARENTS, range(J)], np.int64),
        "bs_style": "lbs",
    }


@pytest.fixture
def uv_pair(tmp_path) -> tuple[pathlib.Path, pathlib.Path]:
    rng = np.random.default_rng(1)
    np.save(tmp_path / "vt.npy", rng.random((70, 2)))
    np.save(tmp_path / "ft.npy", rng.integers(70, size=(F, 3)).astype(np.uint32))
    return tmp_path / "vt.npy", tmp_path / "ft.npy"


@pytest.fixture
def chumpy(monkeypatch) -> types.SimpleNamespace:
    """Classes that pickle as chumpy's do: state {"x"} for arrays; {"a", "idxs", "preferred_shape"} for selections."""
    classes = {}
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    for module, name in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):

        def set_state(self, **state: object) -> None:
            self.__dict__.update(state)

        classes[name] = type(name, (), {"__module__": module, "__init__": set_state})
        monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(**{name: classes[name]}))
    return types.SimpleNamespace(**classes)


def pickled(tmp_path: pathlib.Path, content: object, protocol: int = 2) -> pathlib.Path:
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps(content, protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_every_pickle_protocol_gives_the_arrays_that_went_in(tmp_path, uv_pair, protocol):
    arrays = smpl_arrays()
    body = load_body(pickled(tmp_path, arrays, protocol), uv=uv_pair)
    np.testing.assert_array_equal(body.template, arrays["v_template"].astype(np.float32))
    np.testing.assert_array_equal(body.pose_basis, arrays["posedirs"].astype(np.float32))
    np.testing.assert_array_equal(body.joint_regressor, arrays["J_regressor"].toarray().astype(np.float32))
    np.testing.assert_array_equal(body.faces, arrays["f"])
    assert body.parents.tolist() == [-1, *PARENTS[1:]]
    np.testing.assert_array_equal(body.uv_faces, np.load(uv_pair[1]))


def test_chumpy_files_of_python_2_agree_with_smplx(tmp_path, uv_pair, chumpy):
    """As the published files are: chumpy arrays, a selection, a sparse regressor, old module names, latin1 bytes."""
    arrays = smpl_arrays()
    order = np.random.default_rng(2).permutation(V * 3 * 207)
    shuffled = np.empty(V * 3 * 207)
    shuffled[order] = arrays["posedirs"].ravel()
    stored = {
        **arrays,
        "v_template": chumpy.Ch(x=arrays["v_template"]),
        "shapedirs": chumpy.Ch(x=np.asfortranarray(arrays["shapedirs"])),
        "posedirs": chumpy.Select(a=chumpy.Ch(x=shuffled), idxs=order, preferred_shape=(V, 3, 207)),
    }
    path = pickled(tmp_path, stored)
    renamed = path.read_bytes()
    for new, old in ((b"cnumpy._core.", b"cnumpy.core."), (b"cscipy.sparse._csc\n", b"cscipy.sparse.csc\n")):
        renamed = renamed.replace(new, old)
    path.write_bytes(renamed)
    body = load_body(path, uv=uv_pair).to(dtype=torch.float64)
    g = torch.Generator().manual_seed(4)
    betas = torch.randn(3, 10, generator=g, dtype=torch.float64)
    theta = 0.7 * torch.randn(3, 72, generator=g, dtype=torch.float64)
    vertices, joints = lbs(
        betas, theta, *(torch.from_numpy(a) for a in (arrays["v_template"][None], arrays["shapedirs"][..., :10])),
        torch.from_numpy(arrays["posedirs"].reshape(-1, 207).T), torch.from_numpy(arrays["J_regressor"].toarray()),
        torch.tensor([-1, *PARENTS[1:]]), torch.from_numpy(arrays["weights"]),
    )  # fmt: skip
    posed = body.shape(betas).pose(BodyPose.from_axis_angle(theta))
    torch.testing.assert_close(posed.vertices, vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(posed.joints[..., :3, 3], joints, atol=1e-5, rtol=0)


def test_npz_loads_and_the_default_body_comes_back_whole(tmp_path):
    body = default_body()
    parents = body.parents.numpy().astype(np.uint32)
    np.savez(
        tmp_path / "body.npz", v_template=body.template, f=body.faces, shapedirs=body.shape_basis,
        posedirs=np.zeros((len(body.template), 3, 207), np.float32), weights=body.skin_weights,
        J_regressor=body.joint_regressor, kintree_table=np.stack([parents, np.arange(J)]), vt=body.uv, ft=body.uv_faces,
    )  # fmt: skip
    loaded = load_body(tmp_path / "body.npz", uv=tmp_path / "body.npz")
    for field in dataclasses.fields(body):
        torch.testing.assert_close(getattr(loaded, field.name), getattr(body, field.name), rtol=0, atol=0)


def test_obj_texture_coordinates_follow_the_bodys_face_order(tmp_path, uv_pair):
    arrays = smpl_arrays()
    vt, ft = np.load(uv_pair[0]), np.load(uv_pair[1])
    lines = [f"vt {u} {v}" for u, v in vt.tolist()]
    distinct = len({frozenset(face) for face in arrays["f"].tolist()}) == F
    assert distinct
    for f in reversed(range(F)):
        corners = np.roll(np.stack([arrays["f"][f], ft[f]], 1), f % 3, axis=0) + 1
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in corners.tolist()))
    (tmp_path / "uv.obj").write_text("\n".join(lines))
    body = load_body(pickled(tmp_path, arrays), uv=tmp_path / "uv.obj")
    np.testing.assert_array_equal(body.uv_faces, ft)
    np.testing.assert_allclose(body.uv, vt, rtol=1e-6)
    (tmp_path / "uv.obj").write_text("\n".join(lines[:-1]))
    with refused(FileError):
        load_body(tmp_path / "SMPL_NEUTRAL.pkl", uv=tmp_path / "uv.obj")


class Hostile:
    """Pickles as a call of something that leaves a trace."""

    def __init__(self, target: object, *arguments: object) -> None:
        self.call = (target, arguments)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.call


@pytest.mark.parametrize(
    "program",
    [
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"cbuiltins\ngetattr\n.",
        b"cnumpy\ncore.multiarray.fromfile\n.",
        b"\x80\x04\x8c\x05numpy\x8c\x16ndarray.__subclasses__\x93.",
        b"ccopy_reg\n_reconstructor\n(cbuiltins\nint\ncbuiltins\nobject\nNtR.",
    ],
)
def test_other_ways_to_reach_code_are_rejected(tmp_path, program):
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(program)
    assert list(pickletools.genops(program))
    with pytest.raises(FileError):
        load_body(path, uv=path)


def spoiled(name: str, value: object) -> dict[str, object]:
    return {**smpl_arrays(), name: value}


NAN = np.where(np.arange(V * 3).reshape(V, 3) == 7, np.nan, 0.0)


@pytest.mark.parametrize(
    ("content", "name"),
    [
        ({k: v for k, v in smpl_arrays().items() if k != "posedirs"}, "'posedirs'"),
        (spoiled("shapedirs", np.zeros((V, 3))), "'shapedirs'"),
        (spoiled("weights", np.zeros((V, 52))), "'weights'"),
        (spoiled("weights", np.zeros((V, J))), "'weights'"),
        (spoiled("v_template", NAN), "'v_template'"),
        (spoiled("v_template", np.full((V, 3), 9e8)), "'v_template'"),
        (spoiled("f", np.full((F, 3), V)), "'f'"),
        (spoiled("f", np.full((F, 3), 0.5)), "'f'"),
        (spoiled("kintree_table", np.array([PARENTS[::-1], range(J)])), "'kintree_table'"),
        (spoiled("J_regressor", "text"), "'J_regressor'"),
        (spoiled("v_template", np.array([["a"] * 3] * V)), "'v_template'"),
        ([1, 2], "list"),
    ],
)
def test_broken_content_is_named(tmp_path, uv_pair, content, name):
    with refused(FileError, name):
        load_body(pickled(tmp_path, content), uv=uv_pair)


def test_wrong_paths_and_texture_files_are_named(tmp_path, uv_pair):
    with refused(FileNotFoundError, "nowhere.pkl"):
        load_body(tmp_path / "nowhere.pkl", uv=uv_pair)
    (tmp_path / "body.fbx").write_bytes(b"")
    with refused(FileError, ".fbx"):
        load_body(tmp_path / "body.fbx", uv=uv_pair)
    path = pickled(tmp_path, smpl_arrays())
    np.save(tmp_path / "short.npy", np.zeros((F - 1, 3), int))
    with refused(FileError, "116"):
        load_body(path, uv=(uv_pair[0], tmp_path / "short.npy"))
    np.save(tmp_path / "far.npy", np.full((F, 3), 70))
    with refused(FileError):
        load_body(path, uv=(uv_pair[0], tmp_path / "far.npy"))
    np.savez(tmp_path / "texts.npz", vt=np.full((F, 2), "a"), ft=np.zeros((F, 3), int))
    with refused(FileError):
        load_body(path, uv=tmp_path / "texts.npz")
    np.save(tmp_path / "objects.npy", np.array([Hostile(print, "ran")]), allow_pickle=True)
    with refused(FileError, "objects.npy"):
        load_body(path, uv=(uv_pair[0], tmp_path / "objects.npy"))
