"""The command `primdiffusion evaluate`: quality of trained models."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from primdiffusion.body.model import BodyPose, read_motion
from primdiffusion.capture.coco import JOINTS
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import load_encoder
from primdiffusion.evaluation import reconstruction
from primdiffusion.evaluation.images import (
    HEAD,
    SIDE,
    TestImage,
    folder_images,
    folder_pictures,
    human_images,
    mesh_images_of_seeds,
)
from primdiffusion.evaluation.metrics import load_lpips
from primdiffusion.evaluation.pose_depth_network import PCK_SHARE, load_pose_depth_network
from primdiffusion.evaluation.pretrained_networks import (
    ClipVision,
    Inception,
    load_clip_vision,
    load_inception,
)
from primdiffusion.evaluation.reconstruction import EvaluationSettings, evaluate, summary
from primdiffusion.evaluation.tables import (
    FRAMES_TIMED,
    KID_SEED,
    Networks,
    Scores,
    check_counts,
    compare_pictures,
    frames_per_second,
    look_at_pictures,
    reference_cells,
    remarks,
    resolution_of,
    table,
)
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.formats.requests import Count, Sampling
from primdiffusion.formats.schema import Range, check
from primdiffusion.human import generate
from primdiffusion.people.assets import open_assets
from primdiffusion.render.march import MarchSettings
from primdiffusion.runtime.device import best_device
from primdiffusion.version import __version__

DESCRIPTION = "Measure the quality of trained models."
MARCH = MarchSettings()


@dataclasses.dataclass(frozen=True)
class EvaluateReconstruction:
    """Compare encoded humans with their captures: PSNR, SSIM, mask overlap, and LPIPS if weights are given.

    Each human is encoded once, from some views of one pose, and rendered from all cameras in all poses.
    """

    captures: Path
    """Folder of captures."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors); the default one if omitted."""
    people: Annotated[int, Range(0)] = 0
    """Number of humans, in the order of their names; 0: all."""
    views: int = 8
    """Number of cameras given to the encoder, spread around the human."""
    frame: int = 0
    """Index of the pose that these views show."""
    size: int = 512
    """Pixels a side of the pictures that are compared."""
    lpips: tuple[Path, ...] = ()
    """LPIPS' weights: one file with all, or torchvision's of VGG16 or AlexNet and the linear weights."""
    json: Path | None = None
    """File for the means and every picture's scores."""

    def run(self) -> None:
        """Evaluate, and print a table.

        Raises:
            ValueError, FileNotFoundError: captures, checkpoint or weights are missing, damaged or do not fit.
        """
        check(self)
        captures = open_captures(self.captures)
        names = captures.subjects[: self.people or None]
        settings = EvaluationSettings(names, given_views=self.views, given_frame=self.frame, size=self.size)
        lpips = load_lpips(self.lpips) if self.lpips else None
        model = load_encoder(self.checkpoint, best_device())
        scores = []
        with tqdm(total=len(names), unit="human", disable=None) as bar:
            for score in evaluate(model, captures, settings, lpips):
                bar.update(len({*names[: bar.n], score.subject}) - bar.n)
                scores.append(score)
        means = summary(scores)
        if self.json is not None:
            record = {
                "version": __version__,
                "checkpoint": dict(model.card),
                "settings": dataclasses.asdict(settings),
                "means": means,
                "pictures": [dataclasses.asdict(score) for score in scores],
            }
            _write(self.json, record)
        print(reconstruction.table(means))


@dataclasses.dataclass(frozen=True)
class EvaluateGeneration:
    """Measure what the paper's Tables 1 and 2 have, at 512 x 512, and the same by our own network.

    Weights files are of the networks that publish them.
    """

    assets: Path | None = None
    """MakeHuman's assets, whose meshes are rendered for --real."""
    checkpoint: Path | None = None
    """Model (.safetensors); the default one if omitted."""
    count: Count = 256
    """Number of humans to generate, from successive seeds."""
    first_seed: int = 0
    """The first seed."""
    steps: int = Sampling.steps
    """Sampling steps."""
    json: Path | None = None
    """File for the figures."""
    fake: Path | None = None
    """Folder of generated pictures of any people, instead of a checkpoint's: square, over white or with alpha."""
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
    kid_subsets: Count = 100
    """Number of random subsets for KID."""
    kid_subset_size: Count = 1000
    """Pictures of each subset."""

    def run(self) -> None:
        """Evaluate, and print a table. Raises as `measure`."""
        check(self)
        record, text = measure(self)
        if self.json is not None:
            _write(self.json, record)
        print(text)


def measure(command: EvaluateGeneration) -> tuple[dict[str, Any], str]:
    """The record of a table, and the table as Markdown.

    Raises:
        ValueError, FileNotFoundError: files are missing, damaged or of other networks, or there are too few pictures.
    """
    poses = choose_poses([read_motion(path) for path in command.motion], command.poses, 0)
    grid = command.count * command.poses * command.views
    check_counts(*(len(folder_pictures(path)) if path is not None else grid for path in (command.fake, command.real)))
    if command.real is not None:
        reals = folder_images(command.real)
    else:
        seeds = range(command.real_seed, command.real_seed + command.count)
        reals = mesh_images_of_seeds(open_assets(command.assets), seeds, poses, command.views)
    networks = Networks(
        load_pose_depth_network(),
        None if command.inception is None else load_inception(command.inception),
        None if command.clip is None else load_clip_vision(command.clip),
    )
    model, fps, resolution = None, None, None
    if command.fake is None:
        model = load_checkpoint(command.checkpoint, best_device())
        first = generate(model, command.first_seed, command.steps)
        fps, resolution = frames_per_second(first, MARCH), resolution_of(first)
        fakes = _model_images(model, command, poses)
    else:
        fakes = folder_images(command.fake)
    fake = _scores(fakes, networks, "generated")
    real = _scores(reals, networks, "real")
    rows = compare_pictures(fake, real, command.kid_subsets, command.kid_subset_size)
    if fps is not None:
        rows["generated"]["fps"] = fps
    rows["floor"] = reference_cells(networks.own.card)
    choices = {**_choices(command, fake, real), "resolution": resolution}
    record = {
        "version": __version__,
        "checkpoint": None if model is None else dict(model.card),
        "choices": choices,
        "rows": {row: {name: cell._asdict() for name, cell in cells.items()} for row, cells in rows.items()},
        "remarks": remarks(rows),
        "own_network": networks.own.card,
    }
    return record, table(rows, choices)


def _model_images(model: DiffusionModel, command: EvaluateGeneration, poses: BodyPose) -> Iterator[TestImage]:
    for seed in range(command.first_seed, command.first_seed + command.count):
        yield from human_images(generate(model, seed, command.steps), poses, command.views, MARCH, best_device())


def _scores(images: Iterator[TestImage], networks: Networks, what: str) -> Scores:
    with tqdm(unit="picture", desc=what, disable=None) as bar:

        def report(done: int) -> None:
            bar.update(done - bar.n)

        return look_at_pictures(images, networks, report)


def _choices(command: EvaluateGeneration, fake: Scores, real: Scores) -> dict[str, Any]:
    """Every choice on which the figures depend."""
    rendered = command.fake is None or command.real is None
    grid = f"{command.poses} poses x {command.views} views"
    seeds = f"seeds {command.first_seed} to {command.first_seed + command.count - 1}, {command.steps} steps"
    meshes_seeds = f"meshes of seeds {command.real_seed} to {command.real_seed + command.count - 1}"
    poses = [str(path) for path in command.motion] or "built-in"
    return {
        "picture": f"{SIDE} x {SIDE} pixels over white, sRGB bytes",
        "generated pictures": f"{fake.pictures}: {command.fake or f'{command.count} humans ({seeds}) in {grid}'}",
        "real pictures": f"{real.pictures}: {command.real or f'{meshes_seeds} in {grid}'}",
        "poses": poses if rendered else "of the pictures",
        "marcher step (m)": MARCH.step if command.fake is None else None,
        "resize": f"as torch-fidelity, to {Inception.SIDE} for Inception and {ClipVision.SIDE} for CLIP",
        "inception": f"pool3, 2048 features, {command.inception}" if command.inception else None,
        "clip": f"image embedding of ViT-B/32, 512 features, {command.clip}" if command.clip else None,
        "KID": f"{command.kid_subsets} subsets of {command.kid_subset_size}, seed {KID_SEED}, cubic kernel",
        "PCKh": f"within {PCK_SHARE} of the distance {HEAD[0]}-{HEAD[1]} in the picture, occluded joints included; "
        f"{', '.join(JOINTS)}",
        "depth error": "inverted depths inside the human, means and standard deviations aligned, mean squared "
        "difference x 100",
        "FPS": f"median of {FRAMES_TIMED} frames of one placed human on {best_device()}"
        if command.fake is None
        else None,
        "own distance": f"Frechet, {min(fake.pictures, real.pictures // 2)} pictures against as many real ones; "
        "row real: the other real ones",
        "own floor": "PCKh and depth error of our network on renders of meshes held out from its training",
    }


def _write(path: Path, record: Mapping[str, Any]) -> None:
    write_atomically(path, json.dumps(record, indent=1) + "\n")


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    commands: dict[str, Any] = {"reconstruction": EvaluateReconstruction, "generation": EvaluateGeneration}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="primdiffusion evaluate", description=DESCRIPTION, args=arguments or ["--help"]
    ).run()
