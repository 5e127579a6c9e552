"""A linear shape space and a joint regressor from people in the same pose."""

from __future__ import annotations

import dataclasses

import numpy as np
from mirror import symmetrise
from skeleton import MIRRORED_JOINT

COMPONENTS = 10
REGRESSOR_VERTICES = 300
REGRESSOR_RADIUS = 0.02
"""Metres; the initial regressor weights fall off with this distance from the joint."""


@dataclasses.dataclass(frozen=True)
class LinearModel:
    """points = mean + basis @ betas; over the sampled people, betas have mean 0 and standard deviation 1."""

    mean: np.ndarray
    """[19158, 3]."""
    basis: np.ndarray
    """[19158, 3, 10]."""
    joint_mean: np.ndarray
    joint_basis: np.ndarray
    betas: np.ndarray
    """[N, 10] of the sampled people."""


def fit_linear_model(vertices: np.ndarray, joints: np.ndarray, surface: np.ndarray, twin: np.ndarray) -> LinearModel:
    """Principal components of the vertices in `surface`; all other points are regressed on the same betas.

    Signs: positive beta 0 is taller; every other positive beta is broader (trunk and head).
    """
    mean = symmetrise(vertices.mean(0, dtype=np.float64), twin)
    centred = (vertices[:, surface] - mean[surface]).reshape(len(vertices), -1)
    eigenvalues, eigenvectors = np.linalg.eigh((centred @ centred.T).astype(np.float64))
    betas = eigenvectors[:, ::-1][:, :COMPONENTS] * np.sqrt(len(vertices))
    betas -= betas.mean(0)
    betas /= betas.std(0)
    explained = eigenvalues[::-1][:COMPONENTS].sum() / eigenvalues.sum()
    print(f"{COMPONENTS} components explain {explained:.4%} of the variance")

    solve = np.linalg.pinv(np.concatenate([np.ones((len(betas), 1)), betas], 1))[1:]
    basis = np.moveaxis(np.tensordot(solve, vertices, 1), 0, -1)
    joint_mean = joints.mean(0)
    joint_basis = np.moveaxis(np.tensordot(solve, joints, 1), 0, -1)

    spread = np.abs(mean[surface, 0])
    for k in range(COMPONENTS):
        taller = basis[surface[mean[surface, 1].argmax()], 1, k] - basis[surface[mean[surface, 1].argmin()], 1, k]
        broader = (np.sign(mean[surface, 0]) * basis[surface, 0, k] * (spread < 0.3)).sum()
        if (taller if k == 0 else broader) < 0:
            basis[..., k], joint_basis[..., k], betas[:, k] = -basis[..., k], -joint_basis[..., k], -betas[:, k]
    basis = np.moveaxis(symmetrise(np.moveaxis(basis, -1, 0), twin), 0, -1)
    joint_mean = symmetrise(joint_mean, MIRRORED_JOINT)
    joint_basis = np.moveaxis(symmetrise(np.moveaxis(joint_basis, -1, 0), MIRRORED_JOINT), 0, -1)
    return LinearModel(mean, basis, joint_mean, joint_basis, betas)


def joint_regressor(linear: LinearModel, surface: np.ndarray, twin: np.ndarray) -> np.ndarray:
    """[24, len(surface)]: weights on nearby vertices, rows summing to 1, that reproduce the joints for any betas.

    Of all such weights, these are closest to a bell around the joint. 3 (1 + 10) + 1 equations in 300 unknowns can be
    met exactly; with non-negative weights the error would be millimetres.
    """
    mean, basis, joint_mean, joint_basis = (
        linear.mean[surface],
        linear.basis[surface],
        linear.joint_mean,
        linear.joint_basis,
    )
    regressor = np.zeros((len(joint_mean), len(mean)))
    for j in range(len(joint_mean)):
        distance = np.linalg.norm(mean - joint_mean[j], axis=1)
        near = np.argsort(distance, kind="stable")[:REGRESSOR_VERTICES]
        guess = np.exp(-(distance[near] - distance[near[0]]) / REGRESSOR_RADIUS)
        guess /= guess.sum()
        shapes = basis[near].reshape(len(near), -1)
        equations = np.concatenate([mean[near], shapes, np.ones((len(near), 1))], 1).T
        targets = np.concatenate([joint_mean[j], joint_basis[j].ravel(), [1.0]])
        gram = equations @ equations.T
        gram += 1e-9 * np.trace(gram) / len(gram) * np.eye(len(gram))
        regressor[j, near] = guess + equations.T @ np.linalg.solve(gram, targets - equations @ guess)
    mirrored = regressor[MIRRORED_JOINT][:, np.searchsorted(surface, twin[surface])]
    return (regressor + mirrored) / 2


def keep_strongest(weights: np.ndarray, count: int) -> np.ndarray:
    """Skin weights with only each vertex's `count` largest, rows summing to 1.

    Weights equal to the first one dropped are dropped too: with only one of a left-right pair, symmetry would be lost.
    """
    first_dropped = np.sort(weights, axis=1)[:, -count - 1, None]
    strongest = np.where(weights > first_dropped + 1e-6, weights, 0)
    return strongest / strongest.sum(1, keepdims=True)
