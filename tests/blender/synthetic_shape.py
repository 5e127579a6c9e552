"""A synthetic person of format version 2: one who has a shape model, with frames as the paper defines them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import synthetic

STENCIL = 5


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


def at(person: dict, betas: np.ndarray) -> dict:
    """The person's arrays at other betas, and how much larger boxes are there: `growth` [K, 3]."""
    vertices = person["template"] + np.einsum("vcb,b->vc", person["shape_basis"].astype(np.float64), betas)
    joints = person["joint_template"] + np.einsum("jcb,b->jc", person["joint_basis"].astype(np.float64), betas)
    position, rotation = frames(vertices, person)
    growth = (sides(vertices, person) / sides(person["vertices"], person)) ** 0.5
    return {
        **person,
        "betas": betas,
        "vertices": vertices,
        "joints": joints,
        "position": position,
        "rotation": rotation,
        "growth": np.pad(growth, [(0, 0), (0, 1)], constant_values=1.0),
    }


def sides(vertices: np.ndarray, model: dict) -> np.ndarray:
    """How long and wide cells are along T and B [K, 2], one after the other by definition."""
    found = []
    for k in range(len(model["face"])):
        du, dv = (
            model[name][k].astype(np.float64) @ vertices[model["stencil_vertex"][k]]
            for name in ("stencil_du", "stencil_dv")
        )
        t = du / np.linalg.norm(du)
        found.append([np.linalg.norm(du), np.linalg.norm(dv - (dv @ t) * t)])
    return np.array(found)


def arrays(count: int = 12, seed: int = 0) -> dict[str, np.ndarray]:
    """The fields of a human.npz: bodies taller by the first beta, wider by the second, anyhow by others."""
    person = synthetic.arrays(count, seed)
    rng = np.random.default_rng(seed + 1)
    surface, rest = person["vertices"], person["joints"]
    basis, joint_basis = rng.normal(0, 0.002, (len(surface), 3, 10)), rng.normal(0, 0.002, (24, 3, 10))
    for points, change in ((surface, basis), (rest, joint_basis)):
        change[..., 0] = points * [0.0, 0.04, 0.0]
        change[..., 1] = points * [0.05, 0.0, 0.05]
    faces = person["faces"].astype(np.int32)
    face = rng.integers(0, len(faces), count).astype(np.int32)
    barycentric = rng.dirichlet([1.0, 1.0, 1.0], count)
    others = rng.integers(0, len(surface), (count, STENCIL - 3))
    model = {
        "template": surface.astype(np.float32),
        "shape_basis": basis.astype(np.float32),
        "joint_template": rest.astype(np.float32),
        "joint_basis": joint_basis.astype(np.float32),
        "faces": faces,
        "face": face,
        "barycentric": barycentric.astype(np.float32),
        "stencil_vertex": np.concatenate([faces[face], others], 1).astype(np.int32),
        "stencil_du": _differences(rng, count),
        "stencil_dv": _differences(rng, count),
    }
    generated = at({**person, **model, "format_version": np.array(2)}, person["betas"] * 0.5)
    del generated["growth"]
    return generated


def _differences(rng: np.random.Generator, count: int) -> np.ndarray:
    """Weights of stencils [count, STENCIL] that sum to zero, as a derivative's do, wherever the body is."""
    weights = rng.normal(0, 1, (count, STENCIL))
    return (weights - weights.mean(1, keepdims=True)).astype(np.float32)


def write(path: Path, count: int = 12, seed: int = 0, **changes: np.ndarray) -> Path:
    """Save a synthetic human.npz, with fields replaced by `changes`."""
    np.savez(path, **{**arrays(count, seed), **changes})
    return path
