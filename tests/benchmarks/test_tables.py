"""The comparison of Table 2: bodies that stand together, rays and keypoints."""

import argparse
import importlib.util

import everywhere
import numpy as np
import pytest
from primdiffusion.capture.coco import KEYPOINTS
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.joints import JOINT_NAMES


def front() -> View:
    """A view of the T pose, 64 pixels wide."""
    intrinsics = np.array([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]])
    return View(intrinsics, np.diag([1.0, -1, -1]), np.array([0.0, -0.3, 3]), 64, 64)


def body() -> tuple[np.ndarray, np.ndarray]:
    return everywhere.posed({"betas": [0.0] * 10, "pose": [0.0] * 72, "translation": [0.0] * 3})


@pytest.mark.skipif(importlib.util.find_spec("pycocotools") is None, reason="there is nothing to read COCO with")
@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="there is nothing to cast rays with")
def test_annotations_of_bodies_that_stand_together_agree_with_rays(tmp_path):
    found = everywhere.coco(argparse.Namespace(size=128, frames=1, cameras=3), tmp_path)
    assert found["coco_annotations"] >= 6
    assert min(found["coco_mask_iou_min"], found["amodal_iou_min"]) > 0.9
    assert found["coco_keypoint_error_px"] < 0.02
    assert found["capture_overhead_ratio_fast"] > 1


@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="there is nothing to cast rays with")
def test_rays_hit_the_body_where_its_joints_are_seen():
    vertices, joints = body()
    view = front()
    distance = everywhere.cast(vertices, view)
    pixels, _ = view.project(joints)
    seen = [JOINT_NAMES.index(name) for name in ("left_hip", "neck", "right_knee")]
    columns, rows = np.floor(pixels[seen]).astype(int).T
    assert np.isfinite(distance[rows, columns]).all()
    assert np.isinf(distance[0]).all()
    assert 0.05 < np.isfinite(distance).mean() < 0.5


def test_a_keypoint_that_is_off_by_two_pixels_is_noticed_unless_it_is_unknown():
    _, joints = body()
    view = front()
    pixels, _ = view.project(joints)
    keypoints = np.zeros((len(KEYPOINTS), 3))
    for place, name in enumerate(KEYPOINTS):
        if name in JOINT_NAMES:
            keypoints[place] = (*pixels[JOINT_NAMES.index(name)] - 0.5, 2)
    assert everywhere.keypoint_error(keypoints.ravel().tolist(), view, joints) < 1e-9
    keypoints[KEYPOINTS.index("left_knee"), 0] += 2
    assert everywhere.keypoint_error(keypoints.ravel().tolist(), view, joints) == pytest.approx(2)
    keypoints[KEYPOINTS.index("left_knee"), 2] = 0
    assert everywhere.keypoint_error(keypoints.ravel().tolist(), view, joints) < 1e-9
