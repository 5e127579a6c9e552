"""The child's drawing without the child: frames, caches, errors."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose
from primdiffusion.commands import render as frame_drawer
from primdiffusion.commands.render import FrameDrawer, map_frame
from primdiffusion.drawing import Scene, ViewSettings, draw
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.formats.requests import DrawRequest, PosedPerson
from primdiffusion.human import framing, place, pose_body
from primdiffusion.human_file import save_human
from primdiffusion.render.march import MarchSettings
from primdiffusion.runtime.failures import to_user_error
from support.errors import refused

WIDTH, HEIGHT = 40, 56
STILL = torch.eye(3, 4).tolist()


@pytest.fixture(scope="module")
def pose():
    return BodyPose.from_axis_angle(0.3 * torch.randn(72, generator=torch.Generator().manual_seed(2)))


@pytest.fixture
def params(human, pose, tmp_path) -> DrawRequest:
    save_human(tmp_path / "a.human.safetensors", human)
    camera = framing(place(human, pose), 23, WIDTH, HEIGHT)
    joints = pose_body(human.betas, pose).skinning[:, :3].tolist()
    return DrawRequest(
        frame=new_frame(tmp_path / "frame", WIDTH, HEIGHT),
        width=WIDTH,
        height=HEIGHT,
        intrinsics=camera.intrinsics.tolist(),
        world_to_camera=camera.world_to_camera.tolist(),
        people=[PosedPerson(tmp_path / "a.human.safetensors", STILL, joints)],
    )


def new_frame(path, width: int, height: int) -> Path:
    np.full(width * height * 5, np.nan, np.float32).tofile(path)
    return path


def drawn(params: DrawRequest, drawer: FrameDrawer | None = None, reports: list | None = None):
    drawer = drawer or FrameDrawer(torch.device("cpu"))
    drawer.draw(params, lambda *report: reports is None or reports.append(report))
    return map_frame(params.frame, *params.size)


def test_the_frame_holds_the_picture_of_the_placed_person_from_its_bottom_row(human, pose, params):
    primitives = place(human, pose)
    want = draw(Scene(primitives), framing(primitives, 23, WIDTH, HEIGHT), ViewSettings(clip=(0.0, 1e10)))
    assert (want.alpha > 0.9).mean() > 0.05
    drawn(params)
    values = np.fromfile(params.frame, np.float32)
    combined = values[: WIDTH * HEIGHT * 4].reshape(HEIGHT, WIDTH, 4)
    depth = values[WIDTH * HEIGHT * 4 :].reshape(HEIGHT, WIDTH)
    assert np.allclose(combined[::-1], want.rgba, atol=2e-3)
    assert np.allclose(depth[::-1], want.depth, rtol=2e-3)


def test_other_betas_draw_the_reshaped_person_whose_boxes_have_grown(human, pose, params):
    betas = human.betas + torch.tensor([0.0, 3.0, 1.0, 2.0, 0.0, 4.0, 0.0, 0.0, 0.0, 0.0])
    joints = pose_body(betas, pose).skinning[:, :3].tolist()
    person = dataclasses.replace(params.people[0], joints=joints, betas=betas.tolist())
    got = drawn(dataclasses.replace(params, people=[person])).rgba
    camera = framing(place(human, pose), 23, WIDTH, HEIGHT)
    grown, ungrown = (
        draw(Scene(place(one, pose)), camera, ViewSettings(clip=(0.0, 1e10))).rgba
        for one in (reshape_human(human, betas), dataclasses.replace(human, betas=betas))
    )
    assert np.abs(grown - ungrown).max() > 0.1
    assert np.allclose(got, grown, atol=2e-3)


@pytest.mark.parametrize("region", [[0, 0, 40, 56], [5, 7, 20, 30], [39, 55, 1, 1], [0, 20, 40, 1]])
def test_a_region_is_the_part_of_the_picture_counted_from_the_bottom_left(params, tmp_path, region):
    whole = drawn(params).rgba[::-1]
    x, y, w, h = region
    part = dataclasses.replace(params, region=region, frame=new_frame(tmp_path / "part", w, h))
    assert np.allclose(drawn(part).rgba[::-1], whole[y : y + h, x : x + w], atol=1e-3)


def test_the_first_band_is_small_where_samples_or_people_are_many(params):
    def first_band(**changes) -> int:
        reports: list = []
        drawn(dataclasses.replace(params, **changes), reports=reports)
        return next(step for _, step, *_ in reports if step > 0)

    assert first_band() == HEIGHT
    assert first_band(step=1e-4) < HEIGHT / 2
    assert first_band(people=20 * params.people) < HEIGHT


def test_people_are_loaded_once_and_placed_once_a_pose(params, monkeypatch, tmp_path):
    calls = []
    for name in ("load_human", "place_skinned"):
        original = getattr(frame_drawer, name)
        monkeypatch.setattr(frame_drawer, name, lambda *a, o=original, n=name: calls.append(n) or o(*a))
    drawer = FrameDrawer(torch.device("cpu"))
    moved_camera = [[*row[:3], row[3] + 0.01] for row in params.world_to_camera]
    drawn(params, drawer)
    drawn(dataclasses.replace(params, world_to_camera=moved_camera, view="boxes"), drawer)
    assert calls == ["load_human", "place_skinned"] or calls == ["place_skinned", "load_human"]
    person = dataclasses.replace(params.people[0], object=[[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0]])
    drawn(dataclasses.replace(params, people=[person]), drawer)
    assert sorted(calls) == ["load_human", "place_skinned", "place_skinned"]
    os.utime(params.people[0].human, ns=(1, 1))
    drawn(params, drawer)
    assert sorted(calls) == ["load_human"] * 2 + ["place_skinned"] * 3, "a file that has changed is read again"


def test_solids_come_from_a_file_of_plain_arrays_and_are_read_again_when_it_changes(params, tmp_path):
    def write(colour):
        corners = np.array([[[-9, -9, 1], [9, -9, 1], [0, 18, 1]]], np.float32)
        np.savez(tmp_path / "s.npz", corners=corners, colour=np.array([colour], np.float32), holdout=np.zeros(1, bool))

    drawer = FrameDrawer(torch.device("cpu"))
    scene = dataclasses.replace(params, solids=str(tmp_path / "s.npz"))
    write((0.9, 0.0, 0.0))
    red = drawn(scene, drawer).rgba
    assert red[20, 20, 0] > 0.4
    assert red[20, 20, 1] == 0
    write((0.0, 0.9, 0.0))
    os.utime(tmp_path / "s.npz", ns=(1, 1))
    assert drawn(scene, drawer).rgba[20, 20, 0] == 0


def test_out_of_memory_names_the_resolution(params, monkeypatch):
    def no_room(*_):
        torch.empty(10**15)

    monkeypatch.setattr(frame_drawer, "draw_in_bands", no_room)
    with refused(MemoryError, f"{WIDTH} x {HEIGHT} pixels") as error:
        drawn(params)
    failure = to_user_error(error.value)
    assert (failure.kind, "resolution" in failure.remedy) == ("out_of_memory", True)


@pytest.mark.parametrize("scale", [0.001, 0.03, 0.8, 300.0])
def test_a_person_of_any_size_looks_the_same(params, tmp_path, scale):
    """Dolls would fall between lattice points made for people, and giants would take a thousand times as long."""
    plain = drawn(params).rgba
    pose = np.array(params.world_to_camera)
    pose[:, 3] *= scale
    person = dataclasses.replace(params.people[0], object=(scale * np.eye(3, 4)).tolist())
    scaled = dataclasses.replace(params, people=[person], world_to_camera=pose.tolist())
    difference = np.abs(drawn(scaled).rgba - plain)
    assert difference.max() < 0.02
    assert difference.mean() < 1e-4


def test_samples_are_those_of_the_default_for_people_of_about_natural_size():
    def objects(*scales: float) -> list:
        return [(scale * np.eye(3, 4)).tolist() for scale in scales]

    for scales in ((), (1.0,), (0.8, 1.3), (-1.0,)):
        assert frame_drawer.settings_for(0.004, objects(*scales)) == MarchSettings()
    both = frame_drawer.settings_for(0.004, objects(1.0, 0.25))
    assert (both.strides, both.spacing) == ((16, 8, 4, 2, 1), 0.00025)
    assert frame_drawer.settings_for(0.004, objects(1e-6, 1e6)).strides[0] == 4 * 2**frame_drawer.MOST_DOUBLINGS


def test_a_camera_that_scales_is_rejected_before_anything_is_drawn(params):
    for view in ("colour", "boxes"):
        wrong = (3 * np.array(params.world_to_camera)).tolist()
        with refused(ValueError, "world_to_camera", "scales"):
            drawn(dataclasses.replace(params, world_to_camera=wrong, view=view))
    assert np.isnan(np.fromfile(params.frame, np.float32)).all()
