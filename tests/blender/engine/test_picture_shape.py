"""A reshaped person in the render engine is the backend's own picture of that body in that pose."""

import math
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import synthetic
from engine_stage import STEP, Z_UP, add_human, camera_by_hand, eight_bit, render_png, set_up_render
from oracle import world_from_model

from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.human_file import shape_model_of
from blender_primdiffusion.scene.shape import betas_of

SIZE = (120, 90)


@pytest.fixture
def stage(extension, saved_scene, oracle, folder, tmp_path):
    """A person of the backend before a camera."""
    camera = set_up_render(saved_scene.scene, SIZE, (0.5, -3.4, 1.2), (math.radians(84), 0, math.radians(9)))
    saved_scene.scene.primdiffusion_render.step = STEP
    person = add_human(folder)
    return SimpleNamespace(person=person, camera=camera, oracle=oracle, folder=folder, out=tmp_path / "picture.png")


def test_the_engine_draws_a_reshaped_posed_person_as_the_backend_does(stage):
    armature = stage.person
    rng = np.random.default_rng(2)
    rotations, translation = synthetic.axis_angle(rng.normal(0, 0.3, (24, 3))), np.array([0.1, 0.05, 0.0])
    pose_from_joint_rotations(armature, rotations, translation)
    armature.primdiffusion_human.betas = [1.5, -2.0, 1.0, 0, 0, 1.0, 0, 0, 0, 0]
    armature.primdiffusion_human.height = 1.82
    bpy.context.view_layer.update()
    body = shape_model_of(stage.person).surface(betas_of(stage.person))
    asked = {
        "folder": str(stage.folder),
        "rotations": rotations.tolist(),
        "translation": translation.tolist(),
        "world": (Z_UP.T @ world_from_model(armature, body) @ Z_UP).tolist(),
        "betas": betas_of(stage.person).tolist(),
    }
    combined, _ = stage.oracle.picture([asked], camera_by_hand(stage.camera, SIZE), SIZE)
    wanted = eight_bit(combined)
    assert 0.02 < (wanted[..., 3] > 0).mean() < 0.98
    assert np.abs(render_png(stage.out) - wanted).max() <= 1
    as_generated, _ = stage.oracle.picture([{**asked, "betas": [0.0] * 10}], camera_by_hand(stage.camera, SIZE), SIZE)
    assert np.abs(eight_bit(as_generated) - wanted).max() > 30
