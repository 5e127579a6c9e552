"""The same person through both programs: cameras and joints do not depend on who draws the pictures."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="the backend has another Python than this Blender")

import torch
from blender_primdiffusion.formats.camera_rig import Rig, bounding_sphere
from loaded_scans import load, own_person
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.render import set_up_capture
from primdiffusion.formats import camera_rig as backend_rig

from blender_primdiffusion.motion.poses import built_in_poses

pytestmark = pytest.mark.any_blender


def test_both_programs_put_cameras_and_joints_in_the_same_places(tmp_path, empty_scene):
    path = own_person(tmp_path / "anna.glb")
    poses = built_in_poses(3)
    theirs = set_up_capture(
        read_person(path),
        BodyPose(torch.from_numpy(poses.rotations).float(), torch.from_numpy(poses.translations).float()),
        backend_rig.Rig(count=5),
    )
    scan = load(path)
    views = Rig(count=5).views(*bounding_sphere(scan.bounds(poses.rotations, poses.translations)))
    joints = np.stack([scan.pose(*pose) for pose in zip(poses.rotations, poses.translations, strict=True)])
    for ours, other in zip(views, theirs.views, strict=True):
        np.testing.assert_allclose(ours.rotation, other.rotation, atol=1e-9)
        np.testing.assert_allclose(ours.translation, other.translation, atol=1e-5)
        np.testing.assert_allclose(ours.project(joints)[0], other.project(theirs.joints)[0], atol=1e-3)
