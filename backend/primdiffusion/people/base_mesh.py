"""MakeHuman's full base mesh (hm08) as a function of the default body's betas; clothes, hair and eyes are fitted to it.

Asset files (.mhclo) refer to its 19,158 vertices by index; part of them is the visible body, the rest are helper
vertices around it. Rest pose, axes and betas are the default body's (`body.model.default_body`).
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True, eq=False)
class BaseMesh:
    """A linear shape model of the base mesh. Its arrays are shared: never write to them."""

    template: Float[np.ndarray, "19158 3"]
    """Vertices at zero betas, metres, float64."""
    shape_basis: Float[np.ndarray, "19158 3 10"]
    """Displacement per unit of each beta, metres; within 0.1 mm of the default body's at plausible betas."""
    joint_index: Int[np.ndarray, "19158 4"]
    """Joints (of 24) that move each vertex."""
    joint_weight: Float[np.ndarray, "19158 4"]
    """Skin weights of these joints; rows sum to one."""
    faces: Int[np.ndarray, "F 3"]
    """Faces of the visible body, indexing the base mesh, in the order of the default body's faces."""
    uv: Float[np.ndarray, "T 2"]
    """Texture coordinates of the skin, v up."""
    uv_faces: Int[np.ndarray, "F 3"]
    """Index into `uv` of each face's corners."""
    rest_from_native: Float[np.ndarray, "24 3 3"]
    """Rotation of each joint from MakeHuman's own pose (arms lowered) to the rest pose, world axes.

    Offsets in .mhclo files are vectors in MakeHuman's pose: rotate them by the blend of these before adding them.
    """
    sample_betas: Float[np.ndarray, "N 10"]
    """Betas of the adults that the shape space was fitted to; mean 0, standard deviation 1 in each component."""
    sample_phenotypes: Float[np.ndarray, "N 11"]
    """Their MakeHuman parameters in [0, 1]; columns named by `phenotype_names` (gender 1 is female)."""
    phenotype_names: tuple[str, ...]

    def vertices(self, betas: Float[np.ndarray, "10"]) -> Float[np.ndarray, "19158 3"]:
        """Vertices at given betas, metres, float64."""
        return self.template + self.shape_basis[..., : len(betas)] @ np.asarray(betas, np.float64)

    @property
    def corner_uv(self) -> Float[np.ndarray, "F 3 2"]:
        """Texture coordinates of every corner of `faces`."""
        return self.uv[self.uv_faces]


@functools.cache
def load_base_mesh() -> BaseMesh:
    """Load the base mesh that ships with the package."""
    with (
        importlib.resources.as_file(importlib.resources.files("primdiffusion.people") / "data/hm08.npz") as path,
        np.load(path) as f,
    ):
        weight = f["joint_weight"].astype(np.float64)
        return BaseMesh(
            template=f["template"].astype(np.float64),
            shape_basis=f["shape_basis"].astype(np.float64),
            joint_index=f["joint_index"].astype(np.int64),
            joint_weight=weight / weight.sum(1, keepdims=True),
            faces=f["faces"].astype(np.int64),
            uv=f["uv"].astype(np.float64),
            uv_faces=f["uv_faces"].astype(np.int64),
            rest_from_native=f["rest_from_native"],
            sample_betas=f["sample_betas"].astype(np.float64),
            sample_phenotypes=f["sample_phenotypes"].astype(np.float64),
            phenotype_names=tuple(str(name) for name in f["phenotype_names"]),
        )
