"""A person for tests: blobs along the bones of SMPL's skeleton, in files as the backend writes them."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from support import tensor_files

STENCIL = 5
NAMES = [
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
]  # fmt: skip
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
_LEFT = {
    "hip": (0.09, -0.09, 0.0), "knee": (0.11, -0.48, 0.0), "ankle": (0.11, -0.9, -0.03), "foot": (0.12, -0.96, 0.1),
    "collar": (0.07, 0.4, 0.0), "shoulder": (0.17, 0.42, -0.01), "elbow": (0.43, 0.42, -0.02),
    "wrist": (0.68, 0.42, -0.02), "hand": (0.76, 0.42, -0.02),
}  # fmt: skip
_MIDDLE = {"pelvis": 0.0, "spine1": 0.1, "spine2": 0.23, "spine3": 0.3, "neck": 0.48, "head": 0.56}


def joints() -> np.ndarray:
    """Rest joints [24, 3] of a T-pose, y up, facing +z, the left at +x."""
    rows = []
    for name in NAMES:
        side, _, part = name.partition("_")
        if name in _MIDDLE:
            rows.append((0.0, _MIDDLE[name], 0.0))
        else:
            x, y, z = _LEFT[part]
            rows.append((x if side == "left" else -x, y, z))
    return np.array(rows)


def random_rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Rotations [count, 3, 3], uniform."""
    return Rotation.from_quat(rng.normal(size=(count, 4)), scalar_first=True).as_matrix()


def axis_angle(vector: np.ndarray) -> np.ndarray:
    """Rotations [..., 3, 3] of axis-angle vectors [..., 3]."""
    vector = np.asarray(vector, np.float64)
    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3)


def skinning(rest_joints: np.ndarray, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """SMPL's world <- rest transforms [24, 4, 4] by definition: each joint turns its subtree about itself."""
    out = np.zeros((24, 4, 4))
    for j, parent in enumerate(PARENTS):
        about = np.eye(4)
        about[:3, :3] = rotations[j]
        about[:3, 3] = rest_joints[j] - rotations[j] @ rest_joints[j]
        if parent < 0:
            about[:3, 3] += translation
        out[j] = about if parent < 0 else out[parent] @ about
    return out


def arrays(count: int = 48, seed: int = 0) -> dict[str, np.ndarray]:
    """The fields of a human and its body, with `count` primitives spread along the bones, weights over several joints,
    and frames as the paper defines them. The body does not follow its shape."""
    rng = np.random.default_rng(seed)
    rest = joints()
    bone = np.arange(count) % 23 + 1
    axis = np.linspace(-1, 1, 8)
    inside = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) < 1.1
    density = np.where(inside, rng.uniform(20, 90, (count, 1, 1, 1)), 0.0) * rng.uniform(0.7, 1, (count, 8, 8, 8))
    hue = np.stack([bone % 3 == 0, bone % 3 == 1, bone % 3 == 2], -1) * 0.7 + 0.1
    rgb = np.clip(hue[:, None, None, None] + rng.normal(0, 0.03, (count, 8, 8, 8, 3)), 0, 1)

    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 9)[:-1], np.linspace(0, 1, 4))
    ring = np.stack([0.06 * np.cos(u), 0.06 * np.sin(u), np.zeros_like(u)], -1).reshape(-1, 3)
    vertices, skin, faces = [], [], []
    for j in range(1, 24):
        start = len(vertices) * len(ring)
        line = rest[PARENTS[j]] * (1 - v.reshape(-1, 1)) + rest[j] * v.reshape(-1, 1)
        vertices.append(line + ring)
        part = np.zeros((len(ring), 24))
        part[:, j], part[:, PARENTS[j]] = v.ravel(), 1 - v.ravel()
        skin.append(part)
        for r in range(3):
            for c in range(8):
                a, b = start + r * 8 + c, start + r * 8 + (c + 1) % 8
                faces += [(a, b, a + 8), (b, b + 8, a + 8)]
    surface = np.concatenate(vertices).astype(np.float32)
    skinned = np.concatenate(skin)
    beyond = PARENTS[np.maximum(PARENTS[np.arange(1, 24)], 0)].repeat(len(ring))  # a third joint, for some
    skinned[np.arange(0, len(skinned), 3), beyond[::3]] += 0.3
    skinned = (skinned / skinned.sum(-1, keepdims=True)).astype(np.float32)
    corners = np.array(faces, np.int32)
    model = {
        "template": surface,
        "shape_basis": np.zeros((len(surface), 3, 10), np.float32),
        "joint_template": rest.astype(np.float32),
        "joint_basis": np.zeros((24, 3, 10), np.float32),
        "faces": corners,
        "skin_weights": skinned,
        "uv_corner": rng.uniform(size=(len(faces), 3, 2)).astype(np.float32),
        **anchors(rng, surface, corners, (bone - 1) * 48 + rng.integers(0, 48, count)),
    }
    position, rotation = frames(surface.astype(np.float64), model)
    half_extent = rng.uniform(0.02, 0.05, (count, 3))
    return {
        **model,
        "meta": np.array(json.dumps({"seed": seed, "steps": 5, "checkpoint": "synthetic", "full_density": 100.0})),
        "betas": rng.normal(size=10),
        "parents": PARENTS,
        "joint_names": np.array(NAMES),
        "joints": rest,
        "vertices": surface.astype(np.float64),
        "position": position,
        "rotation": rotation,
        "half_extent": half_extent,
        "rest_half_extent": half_extent * 1.25,
        "primitive_weights": weights_of(model),
        "rgb": rgb.astype(np.float16),
        "density": density.astype(np.float32),
    }  # fmt: skip


def anchors(rng: np.random.Generator, surface: np.ndarray, faces: np.ndarray, face: np.ndarray) -> dict:
    """Where primitives sit on faces [K], with stencils that turn them anyhow."""
    others = rng.integers(0, len(surface), (len(face), STENCIL - 3))
    vertex = np.concatenate([faces[face], others], 1)
    wanted = random_rotations(rng, len(face))
    weights = []
    for k, points in enumerate(surface[vertex].astype(np.float64)):
        equations = np.concatenate([points.T, np.ones((1, STENCIL))])  # a derivative's weights sum to zero
        sides = np.concatenate([wanted[k, :, :2], np.zeros((1, 2))])
        weights.append(np.linalg.lstsq(equations, sides, rcond=None)[0])
    du, dv = np.moveaxis(np.array(weights), -1, 0).astype(np.float32)
    return {
        "face": face.astype(np.int32),
        "barycentric": rng.dirichlet([1.0, 1.0, 1.0], len(face)).astype(np.float32),
        "stencil_vertex": vertex.astype(np.int32),
        "stencil_du": du,
        "stencil_dv": dv,
    }


def frames(vertices: np.ndarray, model: dict) -> tuple[np.ndarray, np.ndarray]:
    """Centres [K, 3] and axes [K, 3, 3] of primitives, one after the other by definition."""
    position, rotation = [], []
    for k, face in enumerate(model["face"]):
        position.append(model["barycentric"][k].astype(np.float64) @ vertices[model["faces"][face]])
        du, dv = (
            model[name][k].astype(np.float64) @ vertices[model["stencil_vertex"][k]]
            for name in ("stencil_du", "stencil_dv")
        )
        t = du / np.linalg.norm(du)
        n = np.cross(t, dv)
        n /= np.linalg.norm(n)
        rotation.append(np.stack([t, np.cross(n, t), n], -1))
    return np.array(position), np.array(rotation)


def weights_of(model: dict) -> np.ndarray:
    """Skinning of primitives [K, 24], one after the other by definition."""
    faces, skin = model["faces"], model["skin_weights"].astype(np.float64)
    return np.array([model["barycentric"][k] @ skin[faces[face]] for k, face in enumerate(model["face"])])


def write(folder: Path, count: int = 48, seed: int = 0, **changes: np.ndarray) -> Path:
    """Save a synthetic human in a folder, with fields replaced by `changes`; returns its file."""
    return save(folder, {**arrays(count, seed), **changes})


def save(folder: Path, human: dict[str, np.ndarray]) -> Path:
    """Save the fields of a human in a folder; returns its file."""
    folder.mkdir(parents=True, exist_ok=True)
    return tensor_files.write_human(folder / "person.human.safetensors", human, json.loads(str(human["meta"])))
