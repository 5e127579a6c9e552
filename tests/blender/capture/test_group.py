"""Groups of people in front of the same cameras, drawn by Cycles and read by the backend."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="the backend has another Python than this Blender")

import torch
from blender_primdiffusion.formats.camera_rig import Rig
from capture_person import NamedPerson, files_of, load_painted, two_poses
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.coco import groups
from primdiffusion.capture.reader import open_captures
from support.errors import refused

from blender_primdiffusion.capture.body import read_body
from blender_primdiffusion.capture.job import run
from blender_primdiffusion.capture.settings import CaptureSettings
from blender_primdiffusion.capture.stage import data_blocks
from blender_primdiffusion.console import Report

pytestmark = pytest.mark.any_blender
POSES = two_poses()


def capture(context, settings: CaptureSettings, people: list[NamedPerson]) -> Report:
    report = Report()
    for _ in run(context, settings, people, report, poses=POSES, load=load_painted):
        pass
    return report


def test_people_stand_together_apart_on_the_floor_in_front_of_the_same_cameras(empty_scene, tmp_path):
    people = [NamedPerson(name) for name in ("anna", "bert", "carl", "dora")]
    rig = Rig(count=3, width=48, height=48)

    def settings(out, **more):
        return CaptureSettings(tmp_path / out, rig=rig, samples=1, device="cpu", together=3, **more)

    before = {block.session_uid for block in data_blocks()}
    assert capture(empty_scene, settings("one"), people).failed == []
    added = [block for block in data_blocks() if block.session_uid not in before]
    assert [block.name for block in added if block.name != "Render Result"] == []
    captures = open_captures(tmp_path / "one")
    assert [[subject.name for subject in group] for group in groups(captures)] == [["anna", "bert", "carl"], ["dora"]]
    body = read_body()
    vertices = {}
    for subject in map(captures.subject, captures.subjects):
        motion = BodyPose.from_axis_angle(torch.from_numpy(subject.smpl.theta)).joint_rotation.double().numpy()
        vertices[subject.name] = [
            body.pose(subject.smpl.betas, *pose)[0] for pose in zip(motion, subject.smpl.translation, strict=True)
        ]
        for camera, view in enumerate(subject.views):
            for frame, points in enumerate(vertices[subject.name]):
                pixels, depth = view.project(points)
                assert (depth > 0).all()
                assert (pixels > -0.5).all()
                assert (pixels < 48.5).all()
                assert (subject.picture("mask", frame, camera) > 128).sum() > 3
    for frame in range(len(POSES)):
        for first, second in (("anna", "bert"), ("anna", "carl"), ("bert", "carl")):
            a, b = (vertices[name][frame][::20, [0, 2]] for name in (first, second))
            assert np.linalg.norm(a[:, None] - b, axis=-1).min() > 0.05
        assert all(abs(points[frame][:, 1].min()) < 0.02 for points in vertices.values())
    assert len({tuple(points[0][0].round(3)) for points in vertices.values()}) == 4
    for number in range(2):
        assert capture(empty_scene, settings("two", shard=(number, 2)), people).failed == []
    one, two = files_of(tmp_path / "one"), files_of(tmp_path / "two")
    same = [name for name in one if name.endswith((".jpg", ".png", "cameras.json"))]
    assert len(same) > 4 * 2 * 3 * 5
    assert all(one[name] == two[name] for name in same)
    with refused(ValueError, "together"):
        settings("three", released_reference=True)
