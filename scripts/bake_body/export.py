"""The contents of the two baked files."""

from __future__ import annotations

import dataclasses
import os
import pathlib

import numpy as np
from linear_model import LinearModel
from primdiffusion.formats.joints import JOINT_NAMES, PARENTS

GRAIN = 2.0**-17
"""Metres (7.6 micrometres): stored lengths are rounded to this grid, so that the files compress."""
UV_GRAIN = 2.0**-16


@dataclasses.dataclass(frozen=True)
class Visible:
    """The part of the base mesh that is the body's skin."""

    vertices: np.ndarray
    """[V] indices into the base mesh, increasing."""
    faces: np.ndarray
    """[F, 3] indices into the base mesh."""
    uv_faces: np.ndarray
    uv: np.ndarray
    """All texture coordinates of the base mesh."""

    def compact_uv(self) -> tuple[np.ndarray, np.ndarray]:
        """Only the texture coordinates in use, and the faces renumbered."""
        used, faces = np.unique(self.uv_faces, return_inverse=True)
        return rounded(self.uv[used], UV_GRAIN), faces.reshape(-1, 3)


def rounded(values: np.ndarray, grain: float = GRAIN) -> np.ndarray:
    """Values rounded to a grid; mirror symmetry is preserved."""
    return (np.round(values / grain) * grain).astype(np.float32)


def smpl_arrays(
    linear: LinearModel, weights: np.ndarray, regressor: np.ndarray, visible: Visible
) -> dict[str, np.ndarray]:
    """The body in SMPL's file format, with its texture coordinates and its vertices' indices in the base mesh."""
    uv, uv_faces = visible.compact_uv()
    template = rounded(linear.mean[visible.vertices])
    parents = np.array(PARENTS)
    parents[0] = 2**32 - 1
    return {
        "v_template": template,
        "shapedirs": rounded(linear.basis[visible.vertices]),
        "posedirs": np.zeros((len(template), 3, 207), np.float32),
        "J_regressor": regressor.astype(np.float32),
        "J": (regressor @ template).astype(np.float32),
        "weights": weights[visible.vertices].astype(np.float32),
        "kintree_table": np.stack([parents, np.arange(24)]).astype(np.uint32),
        "f": np.searchsorted(visible.vertices, visible.faces).astype(np.uint32),
        "vt": uv,
        "ft": uv_faces.astype(np.uint32),
        "bs_type": np.array("lrotmin"),
        "bs_style": np.array("lbs"),
        "joint_names": np.array(JOINT_NAMES),
        "hm08_vertex_index": visible.vertices.astype(np.int32),
    }


def base_mesh_arrays(
    linear: LinearModel,
    weights: np.ndarray,
    visible: Visible,
    phenotypes: dict[str, np.ndarray],
    rest_from_native: np.ndarray,
) -> dict[str, np.ndarray]:
    """The whole base mesh with the same betas, and the sampled people that it was fitted to."""
    uv, uv_faces = visible.compact_uv()
    strongest = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    return {
        "template": rounded(linear.mean),
        "shape_basis": rounded(linear.basis).astype(np.float16),
        "joint_index": strongest.astype(np.uint8),
        "joint_weight": np.take_along_axis(weights, strongest, 1).astype(np.float16),
        "faces": visible.faces.astype(np.uint16),
        "uv": uv,
        "uv_faces": uv_faces.astype(np.uint16),
        "rest_from_native": rest_from_native,
        "sample_betas": linear.betas.astype(np.float32),
        "sample_phenotypes": np.stack(list(phenotypes.values()), 1).astype(np.float16),
        "phenotype_names": np.array(list(phenotypes)),
    }


def report_errors(
    linear: LinearModel, regressor: np.ndarray, vertices: np.ndarray, joints: np.ndarray, surface: np.ndarray
) -> None:
    """Print the distance of the linear model from the people it was fitted to, in millimetres."""
    rebuilt = linear.mean[surface].astype(np.float32) + np.moveaxis(
        linear.basis[surface].astype(np.float32) @ linear.betas.T.astype(np.float32), -1, 0
    )
    for name, error in (
        ("surface", np.linalg.norm(rebuilt - vertices[:, surface], axis=-1)),
        ("regressed joints", np.linalg.norm(regressor @ rebuilt - joints, axis=-1)),
    ):
        mean, most, worst = error.mean() * 1e3, np.percentile(error, 95) * 1e3, error.max() * 1e3
        print(f"{name}: mean {mean:.2f} mm, 95 % below {most:.2f}, worst {worst:.2f}")
    height = np.ptp(vertices[:, surface, 1], axis=1)
    print(f"heights {height.min():.2f} to {height.max():.2f} m, mean {height.mean():.2f}")


def write_npz(path: pathlib.Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a compressed npz under a temporary name, then rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".partial.npz")
    np.savez_compressed(temporary, **arrays)
    os.replace(temporary, path)
    print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")
