"""Compares captures from Cycles and from the rasteriser, and measures how fast training can read them.

`python benchmarks/captures.py --assets DIR --json F` makes a few people, renders them with the extension's command in
a child process (uniform light, 16 samples per pixel) and draws the same views with the rasteriser (9 samples per
pixel). Seconds per view include writing all passes, and exclude start-up and the first view. Cycles uses all cores, the
rasteriser one process with one core: `fast_speedup` is the ratio of processor seconds, which is what a machine gains
with all cores busy; `fast_speedup_wall_one_process` is the ratio of wall seconds.
PSNR is of sRGB bytes over the pixels that either picture covers, both as JPEGs of the kind that Blender writes, with
half the colour resolution (the rasteriser's own files have full resolution). `joint_reprojection_px_max` is between the
joints that the extension saved from Blender's armature and the joints of the backend's body, computed from the SMPL
parameters and cameras on disk. `picture_shift_px_max` is the displacement between Cycles' pictures and those drawn from
the same files. `capture_overhead_ratio` is the time of rendering a view in Cycles and annotating it as COCO, divided
by that of rendering it. Null: not measured (`--quick` skips the 200 views and people_per_second; without bpy nothing of
Cycles is measured).
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import io
import itertools
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.coco import write_coco
from primdiffusion.capture.dataset import CaptureDataset, SampleSettings, batches
from primdiffusion.capture.people_files import find_people, read_person
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import Captures, Subject, body_joints, joints_of, open_captures
from primdiffusion.capture.render import (
    JPEG_QUALITY,
    RenderJob,
    render,
    render_frames,
    set_up_capture,
    srgb_bytes,
    write_parameters,
)
from primdiffusion.files.picture_files import DEPTH_UNIT
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.wardrobe import required_meshes
from record import command_line, report

ROOT = Path(__file__).resolve().parents[1]
MARK = b"PRIMDIFFUSION "
"""Begins each line of progress of the capture command."""
SIZE, SAMPLES = 512, 3
FIRST_SEED = 20_000_000
"""The seed of the first person; training sets count from 0."""
TIMED_PEOPLE, WARM_UP = 16, 4
"""People that are timed, and people that each worker makes before."""
GROWTH_VIEWS, GROWTH_FROM = 200, 20
"""The number of views in the memory test, and how many of them are warm-up."""
SAME_DEPTH_M = 0.002


@dataclasses.dataclass(frozen=True)
class Moment:
    """Time and memory of the capture command when it has finished a view."""

    wall_s: float
    processor_s: float
    """Processor seconds of the process so far."""
    resident_mb: float


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--people", type=int, default=3, help="number of people to compare")
    parser.add_argument("--cameras", type=int, default=6, help="number of cameras for each of the four poses")
    parser.add_argument("--out", type=Path, help="save people and captures here")
    parser.add_argument("--quick", action="store_true", help="one person, few views")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.out or Path(scratch)
        assets = open_assets(arguments.assets, required_meshes())
        count, poses, cameras = (1, 2, 3) if arguments.quick else (arguments.people, 4, arguments.cameras)
        for _ in make_people(assets, PeopleSet(folder / "people", FIRST_SEED, count), 1):
            pass
        figures = {"people_per_second": None if arguments.quick else _people_per_second(assets)}
        figures |= _rasteriser_figures(folder, poses, cameras)
        figures |= _cycles_figures(folder, poses, cameras) if importlib.util.find_spec("bpy") else _no_cycles_figures()
        both = (figures["processor_seconds_a_view_cycles_512"], figures["processor_seconds_a_view_fast_512"])
        figures["fast_speedup"] = both[0] / both[1] if both[0] else None
        walls = (figures["seconds_a_view_cycles_512"], figures["seconds_a_view_fast_512"])
        figures["fast_speedup_wall_one_process"] = walls[0] / walls[1] if walls[0] else None
        measurable = not arguments.quick and importlib.util.find_spec("bpy")
        figures["memory_growth_mb_over_200_views"] = _memory_growth_mb(folder) if measurable else None
        figures |= _loader_figures(folder, 1.5 if arguments.quick else 5.0)
    report(figures, arguments.json)


def _people_per_second(assets: Assets) -> float:
    """Rate of `make_people` with one worker per core, after the first WARM_UP people of each worker."""
    workers = os.cpu_count() or 1
    first = WARM_UP * workers
    with tempfile.TemporaryDirectory() as folder:
        making = make_people(assets, PeopleSet(Path(folder), 0, TIMED_PEOPLE + first), workers)
        moments = [(done, time.perf_counter()) for done in making]
    started = next(moment for done, moment in moments if done >= first)
    return TIMED_PEOPLE / (moments[-1][1] - started)


def _rasteriser_figures(folder: Path, poses: int, cameras: int) -> dict[str, float]:
    """Draws every person in one process; the first view of each person is not timed."""
    taken = built_in_poses().map(lambda values: values[:poses])
    job = RenderJob(find_people(folder / "people"), taken, folder / "fast", Rig(count=cameras), samples=SAMPLES)
    list(
        render(RenderJob(dict(itertools.islice(job.people.items(), 1)), taken, folder / "warm", Rig(count=1, width=64)))
    )
    shutil.rmtree(folder / "warm")
    per_view = []
    for name, path in job.people.items():
        sitting = set_up_capture(read_person(path), taken, job.rig)
        write_parameters(folder / "timed" / name, sitting)
        moments = [
            (time.perf_counter(), time.process_time())
            for _ in render_frames(folder / "timed" / name, sitting, range(poses), job.passes, SAMPLES)
        ]
        per_view.append((np.array(moments[-1]) - moments[0]) / (len(moments) - 1))
    shutil.rmtree(folder / "timed")
    assert all(outcome.status != "failed" for outcome in render(job))
    wall, processor = np.mean(per_view, axis=0)
    return {"seconds_a_view_fast_512": float(wall), "processor_seconds_a_view_fast_512": float(processor)}


def _cycles_figures(folder: Path, poses: int, cameras: int) -> dict[str, float | None]:
    moments = _run_cycles(folder / "people", folder / "cycles", poses, cameras, SIZE)
    captures = open_captures(folder / "cycles")
    wall, processor = _seconds_per_view(moments, len(captures.subjects))
    differences = compare(captures, find_people(folder / "people"), SAMPLES)
    began = time.perf_counter()
    write_coco(captures, {})
    annotating = (time.perf_counter() - began) / len(differences)
    return {
        "seconds_a_view_cycles_512": wall,
        "processor_seconds_a_view_cycles_512": processor,
        "capture_overhead_ratio": 1 + annotating / wall,
        "views_compared": len(differences),
        "mask_iou_fast_vs_cycles": float(np.mean([d.mask_iou for d in differences])),
        "mask_iou_fast_vs_cycles_min": min(d.mask_iou for d in differences),
        "psnr_fast_vs_cycles": 10 * math.log10(255**2 / np.mean([d.squared for d in differences])),
        "psnr_fast_vs_cycles_min": 10 * math.log10(255**2 / max(d.squared for d in differences)),
        "depth_share_within_2_mm": float(np.mean([d.depth_share for d in differences])),
        "part_share_same": float(np.mean([d.part_share for d in differences])),
        "picture_shift_px_max": max(d.shift_px for d in differences),
        "joint_reprojection_px_max": max(joint_error_px(captures.subject(name)) for name in captures.subjects),
    }


def _run_cycles(people: Path, out: Path, poses: int, cameras: int, size: int, *more: str) -> list[Moment]:
    """Render captures in Cycles under uniform light; one Moment per view. Raises RuntimeError if the command fails."""
    command = [
        sys.executable, "-m", "blender_primdiffusion.capture", "--people", people, "--out", out, "--poses", poses,
        "--cameras", cameras, "--size", size, size, "--progress", "json", *more,
    ]  # fmt: skip
    with subprocess.Popen(list(map(str, command)), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        process, moments = psutil.Process(child.pid), []
        for line in child.stdout:
            if line.startswith(MARK) and child.poll() is None:
                used = process.cpu_times()
                resident = process.memory_info().rss / 1e6
                moments.append(Moment(time.perf_counter(), used.user + used.system, resident))
        errors = child.stderr.read().decode(errors="replace")
    if child.returncode:
        raise RuntimeError(f"the capture command ended with {child.returncode}: {errors[-2000:]}")
    return moments


def _no_cycles_figures() -> dict[str, float | None]:
    names = ("seconds_a_view_cycles_512", "processor_seconds_a_view_cycles_512", "capture_overhead_ratio",
             "mask_iou_fast_vs_cycles", "psnr_fast_vs_cycles", "joint_reprojection_px_max")  # fmt: skip
    return dict.fromkeys(names)


def _seconds_per_view(moments: list[Moment], people: int) -> tuple[float, float]:
    """Wall and processor seconds per view, without each person's first view, which includes loading."""
    each = len(moments) // people
    later = [pair for i, pair in enumerate(itertools.pairwise(moments), start=1) if i % each]
    wall = sum(after.wall_s - before.wall_s for before, after in later) / len(later)
    return wall, sum(after.processor_s - before.processor_s for before, after in later) / len(later)


def _memory_growth_mb(folder: Path) -> float:
    """Growth of the memory of Cycles' process between view 20 and view 200, in MB."""
    poses, cameras = 5, GROWTH_VIEWS // 5
    first = next(iter(find_people(folder / "people")))
    moments = _run_cycles(folder / "people", folder / "growth", poses, cameras, 64, "--samples", "1", "--only", first)
    return moments[-1].resident_mb - moments[min(GROWTH_FROM, len(moments) - 1)].resident_mb


def _loader_figures(folder: Path, seconds: float) -> dict[str, float]:
    """Views per second that one worker delivers to training, in batches of 2 samples of 4 + 4 views."""
    captures = open_captures(folder / "fast")
    return {f"loader_views_per_second_{size}": _views_per_second(captures, size, seconds) for size in (512, 256)}


def _views_per_second(captures: Captures, size: int, seconds: float) -> float:
    dataset = CaptureDataset(captures, SampleSettings(4, 4, size, "whole", "first"))
    stream = batches(dataset, 2, workers=1)
    with contextlib.closing(stream):
        for _ in range(2):
            next(stream)
        start, views = time.perf_counter(), 0
        while time.perf_counter() - start < seconds:
            batch, _ = next(stream)
            views += batch.conditioning.mask.shape[:2].numel() + batch.target.mask.shape[:2].numel()
        return views / (time.perf_counter() - start)


@dataclasses.dataclass(frozen=True)
class Difference:
    mask_iou: float
    """Intersection over union of the masks, where their value is above one half."""
    squared: float
    """Mean squared difference of colour bytes over pixels that either covers, both from JPEGs of the same kind."""
    depth_share: float
    """Share of pixels with a depth in either picture whose depths agree within SAME_DEPTH_M."""
    part_share: float
    """Share of those pixels that show the same part in both pictures."""
    shift_px: float
    """Displacement between the two pictures in pixels."""


def compare(captures: Captures, people: dict, samples: int) -> list[Difference]:
    """Draws every view of `captures` again with the rasteriser, from the SMPL parameters and cameras on disk."""
    differences = []
    for name in captures.subjects:
        subject = captures.subject(name)
        smpl = subject.smpl
        poses = BodyPose.from_axis_angle(torch.from_numpy(smpl.theta), torch.from_numpy(smpl.translation))
        sitting = set_up_capture(read_person(people[name]), poses, subject.views)
        for frame in range(subject.frames):
            draw = sitting.person.posed(sitting.skinning[frame])
            for camera, view in enumerate(subject.views):
                differences.append(_difference(subject, frame, camera, draw(view, samples)))
    return differences


def joint_error_px(subject: Subject) -> float:
    """The largest distance between joints saved with the captures and those of the backend's body, in pixels."""
    saved, ours = joints_of(subject), body_joints(subject, default_body())
    differences = [view.project(ours)[0] - view.project(saved)[0] for view in subject.views]
    return float(np.linalg.norm(differences, axis=-1).max())


def _difference(subject: Subject, frame: int, camera: int, shot) -> Difference:
    stored = {kind: subject.picture(kind, frame, camera) for kind in ("img", "mask", "depth", "part")}
    colours, coverage = srgb_bytes(shot.rgb), np.round(shot.alpha * 255)
    ours, theirs = coverage > 127, stored["mask"] > 127
    covered = (coverage > 0) | (stored["mask"] > 0)
    difference = _as_blender_stores(colours)[covered].astype(float) - stored["img"][covered]
    depth = stored["depth"] * DEPTH_UNIT
    either = (depth > 0) | np.isfinite(shot.depth)
    return Difference(
        mask_iou=float((ours & theirs).sum() / (ours | theirs).sum()),
        squared=float((difference**2).mean()),
        depth_share=float((np.abs(depth - shot.depth) < SAME_DEPTH_M)[either].mean()),
        part_share=float((stored["part"] == shot.part)[either].mean()),
        shift_px=_shift(stored["img"].astype(float), colours.astype(float)),
    )


def _as_blender_stores(colours: np.ndarray) -> np.ndarray:
    """The colours after a JPEG with half the colour resolution, as Blender writes it; the rasteriser's have full."""
    file = io.BytesIO()
    Image.fromarray(colours).save(file, "JPEG", quality=JPEG_QUALITY, subsampling="4:2:0")
    with Image.open(file) as picture:
        return np.asarray(picture)


def _shift(first: np.ndarray, second: np.ndarray) -> float:
    """The displacement in pixels that explains most of the difference of two pictures (Lucas and Kanade 1981)."""
    down, across = np.gradient(second, axis=(0, 1))
    gradients = np.stack([across.ravel(), down.ravel()], -1)
    return float(np.linalg.norm(np.linalg.lstsq(gradients, (first - second).ravel(), rcond=None)[0]))


if __name__ == "__main__":
    main()
