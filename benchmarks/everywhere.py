"""Measures how the programs do elsewhere: other systems, other programs, other devices.

    python benchmarks/everywhere.py --json docs/results/everywhere.json
    python benchmarks/everywhere.py --parts coco --size 128 --frames 2 --cameras 3    # a quick try of one part

- types: errors that pyright finds when it checks as on Windows and on macOS.
- wheel: its size, and the median time of a new process that imports `generate` and `march`, and so torch, from the
  unpacked wheel alone.
- coco: bodies that stand together are rendered and annotated. pycocotools decodes the masks, and embree casts a ray
  through each pixel's centre at the bodies posed by the annotations' SMPL parameters: the least intersection over union
  of visible masks and of amodal ones (people of at least LEAST_PIXELS visible pixels), and the largest distance between
  keypoints with a joint in SMPL and the joint's projection by the image's K, R, T. `capture_overhead_ratio_fast` is the
  time of rasterising and annotating, divided by that of rasterising, after a small capture that loads and compiles what
  both need. No human is drawn faster than these bodies of one colour: dressed people take longer, and their annotations
  do not. captures.py has the same for Cycles.
- viewer: the size of the extension without set-up.
- glb: seconds of `primdiffusion export` to .glb, of a generated human, kernels being compiled.
- kernels: how many of Triton's kernels use the stack when compiled for sm_90, which needs no such device.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
import trimesh
from primdiffusion import cli
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.coco import KEYPOINTS, write_coco
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.formats.camera_rig import Rig, View
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.human import generate
from primdiffusion.human_file import save_human
from record import command_line, report

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "backend")]  # as for the tests' helpers

from capture_scenes import body_mesh, save_person  # noqa: E402
from support import hopper  # noqa: E402
from support.wheel import build_archives  # noqa: E402

from build_addon import build  # noqa: E402

PEOPLE, SEED = 3, 7
LEAST_PIXELS = 100
IMPORTS = 5
SAMPLE_SETS = ((2, 2), (1, 4), (1, 1), (4, 1))
"""Sets of boxes and gaps that the forward kernel is compiled for."""
Figures = dict[str, float | int | None]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="measure only these; all by default")
    parser.add_argument("--size", type=int, default=512, help="width and height of the captures, pixels")
    parser.add_argument("--frames", type=int, default=4, help="poses in the captures")
    parser.add_argument("--cameras", type=int, default=6, help="views of each pose")
    arguments = parser.parse_args()
    figures: Figures = {}
    for name in arguments.parts or PARTS:
        print(f"{name} ...", flush=True)
        with tempfile.TemporaryDirectory(prefix="primdiffusion_everywhere_") as folder:
            figures |= PARTS[name](arguments, Path(folder))
    report(figures, arguments.json)


def types(_: argparse.Namespace, __: Path) -> Figures:
    figures: Figures = {}
    for system in ("Windows", "Darwin"):
        command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--pythonplatform", system]
        done = subprocess.run([*command, "--outputjson"], cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
        figures[f"pyright_errors_{system.lower()}"] = json.loads(done.stdout)["summary"]["errorCount"]
    return figures


def wheel(_: argparse.Namespace, folder: Path) -> Figures:
    (path,) = build_archives(folder).glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder / "site")
    environment = {**os.environ, "PYTHONPATH": str(folder / "site")}
    script = "import primdiffusion; print(primdiffusion.__file__); primdiffusion.generate, primdiffusion.march"
    seconds = []
    for _run in range(IMPORTS + 1):
        began = time.perf_counter()
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, encoding="utf-8", check=True)
        seconds.append(time.perf_counter() - began)
        assert Path(done.stdout.strip()).is_relative_to(folder), f"{done.stdout.strip()} is not the wheel's"
    return {"wheel_mb": path.stat().st_size / 1e6, "wheel_import_seconds": statistics.median(seconds[1:])}


def coco(given: argparse.Namespace, folder: Path) -> Figures:
    from pycocotools.coco import COCO

    mesh = body_mesh()
    people = {f"p{i}": save_person(folder / "people" / f"p{i}" / "person.glb", mesh) for i in range(PEOPLE)}
    poses = built_in_poses().map(lambda values: values[: given.frames])
    rig = Rig(count=given.cameras, width=given.size, height=given.size)
    job = RenderJob(people, poses, folder / "captures", rig, together=(people,))
    warm = RenderJob(people, poses.map(lambda values: values[:1]), folder / "warm", Rig(count=1), together=(people,))
    assert {outcome.status for outcome in render(warm)} == {"done"}
    write_coco(open_captures(warm.out), {})
    began = time.perf_counter()
    assert {outcome.status for outcome in render(job)} == {"done"}
    rendered = time.perf_counter() - began
    write_coco(open_captures(job.out), {})
    overhead = (time.perf_counter() - began) / rendered
    annotations = COCO(job.out / "annotations.json")
    visible, amodal, apart = [], [], []
    for image in annotations.loadImgs(annotations.getImgIds()):
        view = View(*(np.array(image[name]) for name in "KRT"), image["width"], image["height"])
        found = annotations.loadAnns(annotations.getAnnIds(imgIds=image["id"]))
        depths = []
        for one in found:
            vertices, joints = posed(one["smpl"])
            depths.append(cast(vertices, view))
            apart.append(keypoint_error(one["keypoints"], view, joints))
        nearest = np.min(depths, axis=0)
        for one, depth in zip(found, depths, strict=True):
            seen = np.isfinite(depth) & (depth == nearest)
            if seen.sum() >= LEAST_PIXELS:
                whole = {**one, "segmentation": one["amodal"]}
                visible.append(overlap(annotations.annToMask(one), seen))
                amodal.append(overlap(annotations.annToMask(whole), np.isfinite(depth)))
    return {
        "coco_annotations": len(visible),
        "coco_mask_iou_min": min(visible),
        "coco_keypoint_error_px": max(apart),
        "amodal_iou_min": min(amodal),
        "capture_overhead_ratio_fast": overhead,
    }


def posed(smpl: dict[str, list[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and joints of the default body, in the world, by the parameters of an annotation."""
    betas, pose, translation = (torch.tensor(smpl[name]) for name in ("betas", "pose", "translation"))
    body = default_body().shape(betas).pose(BodyPose.from_axis_angle(pose, translation))
    return body.vertices.double().numpy(), body.joints[:, :3, 3].double().numpy()


def cast(vertices: np.ndarray, view: View) -> np.ndarray:
    """Distance along the ray through each pixel's centre to the body [H, W]; inf where it passes by."""
    mesh = trimesh.Trimesh(vertices, default_body().faces.numpy(), process=False)
    rows, columns = np.mgrid[: view.height, : view.width] + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], -1).reshape(-1, 3) @ np.linalg.inv(view.intrinsics).T
    origins = np.tile(view.position, (len(rays), 1))
    at, ray, _ = mesh.ray.intersects_location(origins, rays @ view.rotation, multiple_hits=False)
    distance = np.full(len(rays), np.inf)
    distance[ray] = np.linalg.norm(at - view.position, axis=1)
    return distance.reshape(view.height, view.width)


def keypoint_error(keypoints: list[float], view: View, joints: np.ndarray) -> float:
    """Largest distance in pixels between keypoints that are SMPL's joints and the joints' projections."""
    named = [(place, JOINT_NAMES.index(name)) for place, name in enumerate(KEYPOINTS) if name in JOINT_NAMES]
    places, of_body = zip(*named, strict=True)
    found = np.reshape(keypoints, (len(KEYPOINTS), 3))[list(places)]
    apart = np.linalg.norm(found[:, :2] + 0.5 - view.project(joints[list(of_body)])[0], axis=1)
    return float(apart[found[:, 2] > 0].max(initial=0.0))


def overlap(mask: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union."""
    return float(np.logical_and(mask, other).sum() / np.logical_or(mask, other).sum())


def viewer(_: argparse.Namespace, folder: Path) -> Figures:
    return {"viewer_mb": build(folder, viewer=True).stat().st_size / 1e6}


def glb(_: argparse.Namespace, folder: Path) -> Figures:
    human = folder / "person.human.safetensors"
    save_human(human, generate(load_checkpoint(), SEED))
    seconds = []
    for _run in range(2):  # the first may compile
        began = time.perf_counter()
        cli.run(["export", str(human), "--out", str(folder / "person.glb")])
        seconds.append(time.perf_counter() - began)
    return {"glb_export_seconds": min(seconds), "glb_mb": (folder / "person.glb").stat().st_size / 1e6}


def kernels(_: argparse.Namespace, folder: Path) -> Figures:
    if importlib.util.find_spec("triton") is None:
        return {"kernels_compiled": None, "kernels_with_stack": None}
    found = [hopper.resources(hopper.compiled(launch), folder) for launch in launches()]
    stacks = [one["STACK"] for one in found if one is not None]
    spilled = sum(stack > 0 for stack in stacks) if len(stacks) == len(found) else None
    return {"kernels_compiled": len(found), "kernels_with_stack": spilled}


def launches() -> Iterator[hopper.Launch]:
    """Every kernel of the marcher, as tests compile them."""
    for index_order in (False, True):
        yield from (hopper.forward(*chosen, index_order=index_order) for chosen in SAMPLE_SETS)
        yield hopper.backward(index_order=index_order)
    yield from hopper.small()


PARTS: dict[str, Callable[[argparse.Namespace, Path], Figures]] = {
    "types": types,
    "wheel": wheel,
    "coco": coco,
    "viewer": viewer,
    "glb": glb,
    "kernels": kernels,
}

if __name__ == "__main__":
    main()
