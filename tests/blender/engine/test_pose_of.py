"""What the engine reads of a posed armature is SMPL's pose, wherever the armature has its origin."""

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from oracle import Z_UP, raised

from blender_primdiffusion.engine.picture import pose_of
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.edit import reshape

BETAS = np.array([1.5, -2.0, 1.0, 0, 0, 1.0, 0, 0, 0, 0])


@pytest.mark.parametrize("shaped", [False, True], ids=["generated", "reshaped"])
def test_joints_and_place_are_those_of_smpls_own_space(saved_scene, tmp_path, shaped):
    person = build_human(saved_scene, synthetic_shape.write(tmp_path / "human"))
    armature, body = person, synthetic_shape.arrays()
    rng = np.random.default_rng(0)
    rotations, translation = synthetic.axis_angle(rng.normal(0, 0.6, (24, 3))), rng.normal(0, 0.5, 3)
    pose_from_joint_rotations(armature, rotations, translation)
    if shaped:
        reshape(person, BETAS)
        body = synthetic_shape.at(body, BETAS)
    place = raised(body["vertices"])[:3, 3]
    armature.rotation_euler, armature.scale = (0.4, -0.3, 2.0), (1.2, 1.2, 1.2)
    bpy.context.view_layer.update()
    evaluated = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    seen = pose_of(evaluated, np.array(evaluated.matrix_world, np.float64))
    joints = synthetic.skinning(body["joints"], rotations, translation)
    np.testing.assert_allclose(seen.joints, joints[:, :3], atol=2e-5)
    model = np.eye(4)
    model[:3, 3] = place
    world = Z_UP.T @ np.array(armature.matrix_world) @ model @ Z_UP
    np.testing.assert_allclose(seen.object_to_world, world[:3], atol=1e-5)
