"""A synthetic person whose body follows its shape."""

from pathlib import Path

import numpy as np
import synthetic


def at(person: dict, betas: np.ndarray) -> dict:
    """The person's arrays at other betas, and how much larger boxes are there: `growth` [K, 3]."""
    vertices = person["template"] + np.einsum("vcb,b->vc", person["shape_basis"].astype(np.float64), betas)
    joints = person["joint_template"] + np.einsum("jcb,b->jc", person["joint_basis"].astype(np.float64), betas)
    position, rotation = synthetic.frames(vertices, person)
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
    """The fields of a human and its body: bodies taller by the first beta, wider by the second, anyhow by others."""
    person = synthetic.arrays(count, seed)
    rng = np.random.default_rng(seed + 1)
    surface, rest = person["vertices"], person["joints"]
    basis, joint_basis = rng.normal(0, 0.002, (len(surface), 3, 10)), rng.normal(0, 0.002, (24, 3, 10))
    for points, change in ((surface, basis), (rest, joint_basis)):
        change[..., 0] = points * [0.0, 0.04, 0.0]
        change[..., 1] = points * [0.05, 0.0, 0.05]
    face = rng.integers(0, len(person["faces"]), count).astype(np.int32)
    others = rng.integers(0, len(surface), (count, synthetic.STENCIL - 3))
    model = {
        "shape_basis": basis.astype(np.float32),
        "joint_basis": joint_basis.astype(np.float32),
        "face": face,
        "barycentric": rng.dirichlet([1.0, 1.0, 1.0], count).astype(np.float32),
        "stencil_vertex": np.concatenate([person["faces"][face], others], 1).astype(np.int32),
        "stencil_du": _differences(rng, count),
        "stencil_dv": _differences(rng, count),
    }
    person |= model
    generated = at({**person, "primitive_weights": synthetic.weights_of(person)}, person["betas"] * 0.5)
    del generated["growth"]
    return generated


def _differences(rng: np.random.Generator, count: int) -> np.ndarray:
    """Weights of stencils [count, STENCIL] that sum to zero, as a derivative's do, wherever the body is."""
    weights = rng.normal(0, 1, (count, synthetic.STENCIL))
    return (weights - weights.mean(1, keepdims=True)).astype(np.float32)


def write(folder: Path, count: int = 12, seed: int = 0, **changes: np.ndarray) -> Path:
    """Save a synthetic human in a folder, with fields replaced by `changes`; returns its file."""
    return synthetic.save(folder, {**arrays(count, seed), **changes})
