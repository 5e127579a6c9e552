"""The same person through both programs: cameras and joints do not depend on who draws the pictures."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="the backend has another Python than this Blender")

import bpy
import scan_fixtures
import torch
from blender_primdiffusion.formats.camera_rig import Rig, bounding_sphere
from capture_child import small
from capture_person import two_poses
from capture_scenes import body_mesh, save_person
from loaded_scans import BETAS, BODY, load
from mathutils import Vector
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.coco import FACE, keypoints_of
from primdiffusion.capture.conditioning import default_betas
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.reader import joints_of, open_captures
from primdiffusion.capture.render import set_up_capture
from primdiffusion.formats import camera_rig as backend_rig

from blender_primdiffusion.capture.job import run
from blender_primdiffusion.capture.scan import load_scan
from blender_primdiffusion.capture.scan_files import find_scans
from blender_primdiffusion.console import Report
from blender_primdiffusion.motion.poses import built_in_poses

pytestmark = pytest.mark.any_blender


def test_both_programs_put_cameras_and_joints_in_the_same_places(tmp_path, empty_scene):
    path = save_person(tmp_path / "anna.glb", body_mesh(), BETAS.tolist())
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


def test_a_rig_with_other_spines_is_captured_for_the_encoder_and_has_a_face(tmp_path, empty_scene):
    _, armature = scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for bone in ("Spine", "Spine1", "Spine2", "Neck"):
        armature.data.edit_bones[f"mixamorig:{bone}"].translate(Vector((0, 0.03, 0.12)))
    bpy.ops.object.mode_set(mode="OBJECT")
    path = scan_fixtures.save(tmp_path / "people" / "anna.glb")
    report = Report()
    for _ in run(bpy.context, small(tmp_path / "out"), find_scans(path), report, poses=two_poses(), load=load_scan):
        pass
    assert report.failed == []
    anna = open_captures(tmp_path / "out").subject("anna")
    assert np.abs(default_betas(anna).numpy()).max() <= 4
    face, joints = keypoints_of(anna)[:, : len(FACE)], joints_of(anna)
    assert np.linalg.norm(face - joints[:, None, 15], axis=-1).max() < 0.2
