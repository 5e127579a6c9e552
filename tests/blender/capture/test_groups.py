"""Groups of people in front of the same cameras, drawn by Cycles and read by the backend."""

import dataclasses

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
from blender_primdiffusion.capture.group import place_group
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


def save_low_sun(path, way) -> None:
    """Radiance's format: a dim sky with one bright texel, 3 degrees above the horizon, in the direction (x, z)."""
    texels = [bytes([32, 32, 32, 126])] * (32 * 64)
    column = int((0.5 - np.arctan2(-way[1], way[0]) / (2 * np.pi)) * 64)  # as Blender maps equirectangular pictures
    texels[15 * 64 + column] = bytes([200, 200, 200, 136])
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 32 +X 64\n" + b"".join(texels))


def test_a_neighbour_shades_its_group_and_changes_colours_alone(empty_scene, tmp_path):
    people = [NamedPerson(name) for name in ("anna", "bert", "carl")]
    rest = dataclasses.replace(POSES, rotations=POSES.rotations[:1], translations=POSES.translations[:1])
    sun = tmp_path / "sun.hdr"

    def settings(out, **more):
        return CaptureSettings(
            tmp_path / out, rig=Rig(count=3, elevations=(0.0,), width=64, height=64), samples=4, device="cpu",
            together=2, light="hdri", hdri=sun, background="transparent", **more,
        )  # fmt: skip

    unlit = CaptureSettings(tmp_path, rig=Rig(count=3), together=2)
    placed = place_group(empty_scene, unlit, people[:2], rest, read_body(), load_painted)
    anna, bert = (placed[name].poses.translations[0, [0, 2]] for name in ("anna", "bert"))
    save_low_sun(sun, bert - anna)
    before = {block.session_uid for block in data_blocks()}
    for out, shadows in (("apart", False), ("shaded", True)):
        report = Report()
        list(run(empty_scene, settings(out, shadows=shadows), people, report, poses=rest, load=load_painted))
        assert report.failed == []
    added = [block for block in data_blocks() if block.session_uid not in before]
    assert [block.name for block in added if block.name != "Render Result"] == []
    apart, shaded = files_of(tmp_path / "apart"), files_of(tmp_path / "shaded")
    assert apart.keys() == shaded.keys()
    changed = {name for name in apart if apart[name] != shaded[name]}
    assert {name.split("/")[1] for name in changed if "/" in name} == {"img", "rgba", "complete.json"}
    assert [name for name in changed if name.startswith("carl")] == []
    darker = dict.fromkeys(("anna", "bert"), 0.0)
    one, other = (open_captures(tmp_path / name) for name in ("apart", "shaded"))
    for name in darker:
        for camera in range(3):
            lit, shadowed = (captures.subject(name).picture("img", 0, camera).astype(int) for captures in (one, other))
            inside = one.subject(name).picture("mask", 0, camera) > 250
            darker[name] = max(darker[name], float((lit - shadowed)[inside].mean()))
    assert darker["anna"] > 30
    assert darker["bert"] < 5


def test_resumed_capture_with_shadows_is_the_same(empty_scene, tmp_path):
    people = [NamedPerson(name) for name in ("anna", "bert")]

    def settings(out, **more):
        rig = Rig(count=2, width=32, height=32)
        return CaptureSettings(tmp_path / out, rig=rig, samples=4, device="cpu", together=2, light="dome", **more)

    assert capture(empty_scene, settings("whole", shadows=True), people).failed == []
    steps = run(empty_scene, settings("cut", shadows=True), people, Report(), poses=POSES, load=load_painted)
    for _ in range(3):
        next(steps)
    steps.close()
    with refused(ValueError, "shadows"):
        capture(empty_scene, settings("cut"), people)
    assert capture(empty_scene, settings("cut", shadows=True), people).failed == []
    whole, cut = files_of(tmp_path / "whole"), files_of(tmp_path / "cut")
    pictures = [name for name in whole if name.endswith((".jpg", ".png"))]
    assert pictures
    assert all(whole[name] == cut[name] for name in pictures)


@pytest.mark.parametrize("more", [{"together": 1, "light": "dome"}, {"together": 2, "light": "uniform"}])
def test_shadows_without_a_neighbour_or_light_are_refused(tmp_path, more):
    with refused(ValueError, "shadows between people"):
        CaptureSettings(tmp_path, shadows=True, **more)
