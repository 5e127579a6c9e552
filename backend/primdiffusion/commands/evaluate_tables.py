"""`primdiffusion evaluate generation --table 1|2`: the paper's tables of a model, or of anybody's pictures."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from primdiffusion.body.model import BodyPose
from primdiffusion.capture.poses import choose_poses
from primdiffusion.device import best_device
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.evaluation.images import (
    HEAD,
    JOINTS,
    SIDE,
    TestImage,
    folder_images,
    folder_pictures,
    human_images,
    mesh_images,
)
from primdiffusion.evaluation.onnx_networks import (
    DepthValues,
    Normalisation,
    open_depth_network,
    open_pose_network,
)
from primdiffusion.evaluation.pose_depth_network import PCK_SHARE, load_pose_depth_network
from primdiffusion.evaluation.pretrained_networks import (
    ClipVision,
    Inception,
    Resize,
    load_clip_vision,
    load_inception,
)
from primdiffusion.evaluation.tables import (
    Cell,
    Networks,
    Scores,
    check_counts,
    compare_pictures,
    evaluate,
    reference_cells,
    remarks,
    table,
)
from primdiffusion.formats.requests import Count
from primdiffusion.human import Human, framing, generate, place
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import make_person
from primdiffusion.pose_file import read_motion
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.version import __version__

FRAMES_TIMED = 10


@dataclasses.dataclass(frozen=True)
class TableOptions:
    """The paper's tables; weights files are of the networks that publish them."""

    table: Literal["1", "2"] | None = None
    """Measure what this table of the paper has, at 512 x 512, and the same by our own network. Needs no --people."""
    fake: Path | None = None
    """Folder of generated pictures of anybody, instead of a checkpoint's: square, over white or with alpha."""
    real: Path | None = None
    """Folder of real pictures; without it, renders of the meshes of MakeHuman's --assets."""
    poses: Count = 5
    """Number of poses of each human: near T, then those of --motion, or built-in ones."""
    views: Count = 4
    """Number of views of each pose, evenly around the human."""
    motion: tuple[Path, ...] = ()
    """Pose files (AMASS and others) to choose poses from."""
    real_seed: int = 3_000_000
    """Seed of the first mesh; as many are rendered as humans are generated."""
    inception: Path | None = None
    """Weights of FID's Inception-V3, pt_inception-2015-12-05-6726825d.pth or torch-fidelity's file."""
    clip: Path | None = None
    """Weights of CLIP's ViT-B/32, under OpenAI's names."""
    pose: Path | None = None
    """ONNX file of a 2D pose network of COCO's 17 keypoints."""
    depth: Path | None = None
    """ONNX file of a monocular depth network."""
    depth_normalisation: Normalisation = "imagenet"
    """Normalisation of the depth network's input; DPT needs `half`."""
    depth_values: DepthValues = "inverted"
    """What the depth network predicts."""
    resize: Resize = "torch-fidelity"
    """How pictures reach the size of Inception and CLIP."""
    kid_subsets: Count = 100
    """Number of random subsets for KID."""
    kid_subset_size: Count = 1000
    """Pictures of each subset."""
    kid_seed: int = 2020
    """Seed of the subsets; torch-fidelity's default."""


@dataclasses.dataclass(frozen=True)
class Generated:
    """Where generated humans come from."""

    checkpoint: Path | None
    first_seed: int
    count: int
    steps: int


def measure(options: TableOptions, generated: Generated, assets: Path | None) -> tuple[dict[str, Any], str]:
    """The record of a table, and the table as Markdown.

    Raises:
        ValueError, FileNotFoundError: files are missing, damaged or of other networks, or there are too few pictures.
        ImportError: an ONNX file is named and onnxruntime is not installed.
    """
    poses = choose_poses([read_motion(path) for path in options.motion], options.poses, 0)
    grid = generated.count * options.poses * options.views
    check_counts(
        grid if options.fake is None else len(folder_pictures(options.fake)),
        grid if options.real is None else len(folder_pictures(options.real)),
    )
    meshes = open_assets(assets) if options.real is None else None
    networks = _open_networks(options)
    settings = MarchSettings()
    model = load_checkpoint(generated.checkpoint, best_device()) if options.fake is None else None
    fps, resolution = None, None
    if model is not None:
        first = generate(model, generated.first_seed, generated.steps)
        fps, resolution = frames_per_second(first, settings), resolution_of(first)
        fakes = _model_images(model, generated, poses, options.views, settings)
    else:
        assert options.fake is not None
        fakes = folder_images(options.fake)
    if meshes is not None:
        reals = _mesh_images(meshes, options, generated.count, poses)
    else:
        assert options.real is not None
        reals = folder_images(options.real)
    fake, real = _evaluated(fakes, networks, "generated"), _evaluated(reals, networks, "real")
    rows = compare_pictures(fake, real, options.kid_subsets, options.kid_subset_size, options.kid_seed)
    if fps is not None:
        rows["generated"]["fps"] = fps
    rows["floor"] = reference_cells(networks.own.card)
    choices = _choices(options, generated, fake, real, settings)
    record = {
        "version": __version__,
        "table": int(options.table or 1),
        "checkpoint": None if model is None else dict(model.card),
        "choices": choices,
        "resolution": resolution,
        "rows": {row: {name: cell._asdict() for name, cell in cells.items()} for row, cells in rows.items()},
        "remarks": remarks(rows),
        "own_network": networks.own.card,
    }
    return record, table(int(options.table or 1), rows, choices, resolution)


def _open_networks(options: TableOptions) -> Networks:
    return Networks(
        load_pose_depth_network(),
        None if options.inception is None else load_inception(options.inception, options.resize),
        None if options.clip is None else load_clip_vision(options.clip, options.resize),
        None if options.pose is None else open_pose_network(options.pose),
        None
        if options.depth is None
        else open_depth_network(options.depth, options.depth_normalisation, options.depth_values),
    )


def _model_images(
    model: DiffusionModel, generated: Generated, poses: BodyPose, views: int, settings: MarchSettings
) -> Iterator[TestImage]:
    for seed in range(generated.first_seed, generated.first_seed + generated.count):
        human = generate(model, seed, generated.steps)
        yield from human_images(human, poses, views, f"{seed:06d}", settings, best_device())


def _mesh_images(assets: Assets, options: TableOptions, count: int, poses: BodyPose) -> Iterator[TestImage]:
    base = load_base_mesh()
    yaws = [[2 * math.pi * view / options.views for view in range(options.views)]] * options.poses
    for seed in range(options.real_seed, options.real_seed + count):
        yield from mesh_images(make_person(assets, base, seed), poses, yaws, f"{seed:08d}", SIDE)


def _evaluated(images: Iterator[TestImage], networks: Networks, what: str) -> Scores:
    with tqdm(unit="picture", desc=what, disable=None) as bar:

        def report(done: int) -> None:
            bar.update(done - bar.n)

        return evaluate(images, networks, report)


def frames_per_second(human: Human, settings: MarchSettings) -> Cell:
    """Frames of 512 x 512 that the marcher draws of a generated human in a second: the median, after one not timed.

    Boxes are placed once; the spread is over frames.
    """
    device = best_device()
    primitives = place(human).to(device)
    seconds = []
    for number in range(FRAMES_TIMED + 1):
        camera = framing(primitives, 360 * number / FRAMES_TIMED, SIDE, SIDE)
        start = time.perf_counter()
        march(primitives, camera, settings)
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    rates = [1 / one for one in seconds[1:]]
    return Cell(statistics.median(rates), statistics.pstdev(rates))


def resolution_of(human: Human) -> str:
    """The paper's way to state it: all boxes side by side, e.g. 256 x 256 x 8 for 32 x 32 boxes of 8^3 voxels."""
    boxes, side = human.payload.density.shape[-4], human.payload.density.shape[-1]
    across = math.isqrt(boxes) * side
    return f"{across} x {across} x {side}" if math.isqrt(boxes) ** 2 == boxes else f"{boxes} x {side}^3"


def _choices(
    options: TableOptions,
    generated: Generated,
    fake: Scores,
    real: Scores,
    settings: MarchSettings,
) -> dict[str, Any]:
    """Every choice on which the figures depend."""
    rendered = options.fake is None or options.real is None
    grid = f"{options.poses} poses x {options.views} views"
    seeds = f"seeds {generated.first_seed} to {generated.first_seed + generated.count - 1}, {generated.steps} steps"
    meshes_seeds = f"meshes of seeds {options.real_seed} to {options.real_seed + generated.count - 1}"
    poses = [str(path) for path in options.motion] or "built-in"
    return {
        "picture": f"{SIDE} x {SIDE} pixels over white, sRGB bytes",
        "generated pictures": f"{fake.pictures}: {options.fake or f'{generated.count} humans ({seeds}) in {grid}'}",
        "real pictures": f"{real.pictures}: {options.real or f'{meshes_seeds} in {grid}'}",
        "poses": poses if rendered else "of the pictures",
        "marcher step (m)": settings.step if options.fake is None else None,
        "resize": f"{options.resize}, to {Inception.SIDE} for Inception and {ClipVision.SIDE} for CLIP",
        "inception": f"pool3, 2048 features, {options.inception}" if options.inception else None,
        "clip": f"image embedding of ViT-B/32, 512 features, {options.clip}" if options.clip else None,
        "KID": f"{options.kid_subsets} subsets of {options.kid_subset_size}, seed {options.kid_seed}, cubic kernel",
        "PCKh": f"within {PCK_SHARE} of the distance {HEAD[0]}-{HEAD[1]} in the picture, occluded joints included; "
        f"{', '.join(JOINTS)}",
        "pose network": f"{options.pose}" if options.pose else None,
        "depth error": "inverted depths inside the human, means and standard deviations aligned, mean squared "
        "difference x 100",
        "depth network": f"{options.depth}, {options.depth_normalisation} normalisation, predicts "
        f"{options.depth_values}"
        if options.depth
        else None,
        "FPS": f"median of {FRAMES_TIMED} frames of one placed human on {best_device()}"
        if options.fake is None
        else None,
        "own distance": f"Frechet, {min(fake.pictures, real.pictures // 2)} pictures against as many real ones; "
        "row real: the other real ones",
        "own floor": "PCKh and depth error of our network on renders of meshes held out from its training",
    }
