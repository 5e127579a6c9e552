"""A capture in a process of its own, to be killed: `python capture_child.py OUT`; prints a line for each view."""

import sys
from pathlib import Path

import bpy
from blender_primdiffusion.formats.camera_rig import Rig
from capture_person import NamedPerson, load_painted, two_poses

from blender_primdiffusion.capture.job import run
from blender_primdiffusion.capture.settings import CaptureSettings

PEOPLE = [NamedPerson("anna"), NamedPerson("bert")]


def small(out: Path, **changes) -> CaptureSettings:
    """Two cameras, few samples."""
    rig = Rig(count=2, elevations=(10.0,), width=64, height=64)
    return CaptureSettings(**{"out": out, "rig": rig, "samples": 2, "device": "cpu", **changes})


if __name__ == "__main__":
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for progress in run(bpy.context, small(Path(sys.argv[1])), PEOPLE, poses=two_poses(), load=load_painted):
        print(f"view {progress.done}", file=sys.stderr, flush=True)
