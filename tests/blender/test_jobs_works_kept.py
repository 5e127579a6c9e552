"""Every kind of work outlives Blender: as JSON and back, it asks the child for the same."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic_shape

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.export_model import FrameRange
from blender_primdiffusion.scene.files import person_file
from blender_primdiffusion.ui.assets.work import HumanAssetWork, PoseAssetWork
from blender_primdiffusion.ui.captures.reconstruct_work import ReconstructWork
from blender_primdiffusion.ui.export.mesh_work import AddProxyWork, ExportMeshWork
from blender_primdiffusion.ui.export.person_work import ExportGaussiansWork, ExportVdbSequenceWork, ImportHumanWork
from blender_primdiffusion.ui.export.posing import posed_frames, posed_now
from blender_primdiffusion.ui.files.works import RegenerateWork, RestoreWork
from blender_primdiffusion.ui.generate.work import GenerateWork
from blender_primdiffusion.ui.human.edit_work import BlendWork, RedressWork, TransferWork, VaryWork
from blender_primdiffusion.ui.jobs import work as work_module
from blender_primdiffusion.ui.jobs.kept import kept_work, work_of
from blender_primdiffusion.ui.jobs.kept_poses import packed, unpacked
from blender_primdiffusion.ui.jobs.target import Target
from blender_primdiffusion.ui.jobs.work import Work
from blender_primdiffusion.ui.render.merge_work import FitGainWork, MergeFramesWork, MergeWork, Moment
from blender_primdiffusion.ui.variations.work import VariationsWork


@pytest.fixture
def person(addon, tmp_path):
    kept = tmp_path / "person.human.safetensors"
    kept.write_bytes(b"kept")
    return build_human(addon, synthetic_shape.write(tmp_path / "human.npz", 6), "Änne", [kept])


def works_about(person: bpy.types.Collection, folder: Path) -> list[Work]:
    target, moment = Target.of(person), Moment.now(person)
    context, range_ = bpy.context, range(1, 4)
    asked = {"attributes": {"sex": "female"}, "guidance": 1.5}
    return [
        GenerateWork(7, 3, "dpmpp_2m", asked, renews_seed=True),
        VariationsWork((3, 4), 8, "ddim", asked),
        VaryWork.of(person, 3, {"amount": 0.5, "seed": 3}),
        RedressWork.of(person, 3, {"region": {"painted": [0.0, 1.0]}, "seed": 3}),
        TransferWork.of(person, 3, {"other": "/a/b"}),
        BlendWork.of(person, 3, {"other": "/a/b", "fraction": 0.5}),
        MergeWork(target, moment, 0.006),
        MergeFramesWork(target, [moment, moment], 5, 0.006),
        FitGainWork(target, moment),
        ExportMeshWork(target, 512, 9000, folder / "ä.glb", "GLB", FrameRange(1, 3)),
        AddProxyWork(target, 512, 9000),
        ExportGaussiansWork(target, folder / "ä.ply", posed_now(context, person), 500),
        ExportVdbSequenceWork(target, folder, "ä", posed_frames(context, person, range_), 1, 0.01),
        ImportHumanWork("/a/ä.human", (1.0, 2.0, 3.0)),
        HumanAssetWork(target),
        PoseAssetWork.of(person, "Lehnt"),
        RestoreWork(target, "/a/person.human.safetensors"),
        RegenerateWork(target, {"seed": 7, "steps": 3}),
        ReconstructWork("/captures", "anna", 3, 8),
    ]


def same(one, other) -> None:
    """Up to single floats."""
    assert type(one) is type(other) or isinstance(one, list | tuple)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            same(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            same(a, b)
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-6)
    else:
        assert one == other


def test_every_kind_asks_for_the_same_after_a_restart(person, tmp_path, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.ui.render.merge_work._Writer.start", lambda _: None)
    works = works_about(person, tmp_path)
    assert {work.kind for work in works} == set(work_module._kinds)
    for number, work in enumerate(works):
        kept = kept_work(work, "Scene", bpy.data.filepath)
        again = work_of(type(kept)(**json.loads(json.dumps(vars(kept)))))
        folder = tmp_path / str(number)
        folder.mkdir()
        same(work.params(folder), again.params(folder))
        assert (again.label, again.kind) == (work.label, work.kind)
        if hasattr(work, "target"):
            assert again.target == Target(None, "Änne", work.target.file)


def test_works_ask_where_the_person_s_file_is_when_their_turn_comes(person, tmp_path, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.ui.render.merge_work._Writer.start", lambda _: None)
    works, before = works_about(person, tmp_path), person_file(person)
    now = before.parent.rename(tmp_path / "elsewhere") / before.name
    for volume in bpy.data.volumes:
        volume.filepath = str(now.parent / Path(volume.filepath).name)
    assert person_file(person) == now
    for work in works:
        asked = json.dumps(work.params(tmp_path))
        assert json.dumps(str(before)) not in asked, work.label
        made_anew = isinstance(work, RestoreWork | RegenerateWork)
        assert (json.dumps(str(now)) in asked) == (hasattr(work, "target") and not made_anew), work.label


def test_variants_of_a_person_say_why_they_end_with_blender():
    work = VariationsWork((3, 4), 8, "ddim", person="/tmp/person.human.safetensors", checkpoint="")
    assert work.not_kept_because == "the person to vary is a temporary file"
    assert kept_work(work, "Scene", "") is None


def test_a_thousand_poses_are_kept_in_two_megabytes(person):
    pose = Moment.now(person).params
    people = [{**pose, "joints": (np.array(pose["joints"]) + number).tolist()} for number in range(1000)]
    text = json.dumps(packed(people))
    assert len(text) < 2.2e6
    again = unpacked(json.loads(text))
    np.testing.assert_allclose([p["joints"] for p in again], [p["joints"] for p in people], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("damage", [{"joints": "AAAA"}, {"joints": "%"}, {"rest": []}, {"joints": 5}])
def test_damaged_poses_are_refused(person, damage):
    kept = packed([Moment.now(person).params] * 2)
    with pytest.raises((ValueError, TypeError)):
        unpacked({**kept, **damage})
