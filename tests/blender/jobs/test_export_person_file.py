"""Jobs about a person find the person's file when their turn comes, wherever it is by then."""

import json
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from human_files import forget_session_files, person_file

from blender_primdiffusion.jobs.export import (
    AddProxyJob,
    ExportGaussiansJob,
    ExportMeshJob,
    posed_frames,
)
from blender_primdiffusion.jobs.generate import EditJob
from blender_primdiffusion.jobs.queue import Job
from blender_primdiffusion.jobs.volumes import MergeJob, PoseSnapshot
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import HumanTarget

pytestmark = pytest.mark.any_blender


@pytest.fixture
def person(addon, tmp_path):
    return build_human(addon, synthetic_shape.write(tmp_path / "human", 6), "Änne")


def jobs_about(person: bpy.types.Object, folder: Path) -> list[Job]:
    target, moment, context = HumanTarget.of(person), PoseSnapshot.capture(person), bpy.context
    return [
        EditJob.of("vary", person, {"steps": 3, "amount": 0.5, "seed": 3}),
        EditJob.of("inpaint", person, {"steps": 3, "region": {"painted": [0.0, 1.0]}, "seed": 3}),
        EditJob.of("transfer", person, {"steps": 3, "other": "/a/b"}),
        EditJob.of("interpolate", person, {"steps": 3, "other": "/a/b", "fraction": 0.5}),
        MergeJob(target, [moment], 0.006),
        ExportMeshJob(target, 512, 9000, folder / "ä.glb", "GLB", range(1, 4)),
        AddProxyJob(target, 512, 9000),
        ExportGaussiansJob(target, folder / "ä.ply", posed_frames(context, person, [1])[0], 500),
    ]


def test_jobs_send_the_file_of_now_when_their_turn_comes(person, tmp_path):
    jobs = jobs_about(person, tmp_path)
    forget_session_files()
    for job in jobs:
        assert json.dumps(str(person_file(person))) in json.dumps(job.params(tmp_path)), job.label
        assert person_file(person).read_bytes() == (tmp_path / "human" / "person.human.safetensors").read_bytes()
        forget_session_files()
