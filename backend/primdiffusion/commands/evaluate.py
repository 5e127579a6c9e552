"""The command `primdiffusion evaluate`: quality of trained models."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tqdm import tqdm

from primdiffusion.body.model import BodyPose
from primdiffusion.body.pose_file import read_motion
from primdiffusion.capture.coco import JOINTS
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import load_encoder
from primdiffusion.evaluation import generation, reconstruction
from primdiffusion.evaluation.attribute_network import features_of
from primdiffusion.evaluation.distances import NEIGHBOURS, too_few_samples
from primdiffusion.evaluation.gallery import (
    COLOURINGS,
    Source,
    made_gallery,
    mesh_sources,
    payload_sources,
    read_seed,
)
from primdiffusion.evaluation.generation import compare, open_reference_set, real_vs_real
from primdiffusion.evaluation.image_metrics import load_lpips
from primdiffusion.evaluation.images import (
    HEAD,
    SIDE,
    TestImage,
    folder_images,
    folder_pictures,
    human_images,
    mesh_images_of_seeds,
)
from primdiffusion.evaluation.pose_depth_network import PCK_SHARE, load_pose_depth_network
from primdiffusion.evaluation.pretrained_networks import (
    ClipVision,
    Inception,
    Resize,
    load_clip_vision,
    load_inception,
)
from primdiffusion.evaluation.reconstruction import EvaluationSettings, evaluate, summary
from primdiffusion.evaluation.tables import (
    FRAMES_TIMED,
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
from primdiffusion.human import generate, place
from primdiffusion.people.assets import open_assets
from primdiffusion.people.stored_people import find_people
from primdiffusion.render.march import MarchSettings
from primdiffusion.runtime.device import best_device
from primdiffusion.training.latents import split_people
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
                "means": {name: dataclasses.asdict(part) for name, part in means.items()},
                "pictures": [dataclasses.asdict(score) for score in scores],
            }
            _write(self.json, record)
        print(reconstruction.table(means))


@dataclasses.dataclass(frozen=True)
class TableOptions:
    """The paper's tables; weights files are of the networks that publish them."""

    table: Literal["1", "2"] | None = None
    """Measure what this table of the paper has, at 512 x 512, and the same by our own network. Needs no --people."""
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
    resize: Resize = "torch-fidelity"
    """Resizing of pictures for Inception and CLIP."""
    kid_subsets: Count = 100
    """Number of random subsets for KID."""
    kid_subset_size: Count = 1000
    """Pictures of each subset."""
    kid_seed: int = 2020
    """Seed of the subsets; torch-fidelity's default."""


@dataclasses.dataclass(frozen=True)
class EvaluateGeneration:
    """Compare generated humans with ones held out from training, in a feature space of human attributes.

    Also reports whether they are copies: their distance to the training set, relative to that of held-out humans. With
    --table, measure what the paper's tables have instead.
    """

    people: Path | None = None
    """Folder of the payloads that the model was trained on, those held out among them."""
    reference: Path | None = None
    """Folder of the feature network that scripts/train_attribute_network.py trains; portraits are kept there."""
    assets: Path | None = None
    """MakeHuman's assets, if the training set was made from them: the reference is then renders of the meshes, so that
    detail which payloads lack counts too. Without them it is renders of the payloads."""
    checkpoint: Path | None = None
    """Model (.safetensors); the default one if omitted."""
    count: Count = 256
    """Number of humans to generate, from successive seeds."""
    first_seed: int = 0
    """The first seed."""
    steps: int = Sampling.steps
    """Sampling steps."""
    holdout: float = 0.05
    """Share that was held out in training."""
    seed: int = 0
    """Seed of the training run."""
    json: Path | None = None
    """File for the figures."""
    tables: tyro.conf.OmitArgPrefixes[TableOptions] = dataclasses.field(default_factory=TableOptions)

    def run(self) -> None:
        """Evaluate, and print a table.

        Raises:
            ValueError, FileNotFoundError: people or checkpoint are missing, damaged or too few.
        """
        check(self)
        if self.tables.table is not None:
            record, text = measure(self)
            if self.json is not None:
                _write(self.json, record)
            print(text)
            return
        if self.people is None or self.reference is None:
            raise ValueError("give --people and --reference, or --table 1 or 2 for the paper's tables")
        if self.count <= NEIGHBOURS:
            raise ValueError(
                f"count is {self.count}: ask for more than {NEIGHBOURS} humans, or nothing can be compared"
            )
        real = real_sources(self.people, self.assets, self.holdout, self.seed)
        model = load_checkpoint(self.checkpoint, best_device())
        with tqdm(unit="human", disable=None) as bar:

            def report(done: int, total: int) -> None:
                bar.update(1)

            reference = open_reference_set(*real, self.reference, report)
        with tqdm(range(self.first_seed, self.first_seed + self.count), unit="human", disable=None) as seeds:
            made = made_gallery(place(generate(model, seed, self.steps)) for seed in seeds)
        rows = {
            "generated": compare(reference, features_of(reference.network, made)),
            "trained on": real_vs_real(reference, self.count),
        }
        if self.json is not None:
            record = {
                "version": __version__,
                "checkpoint": dict(model.card),
                "people": {name: dataclasses.asdict(row) for name, row in rows.items()},
                "feature_accuracy": reference.network.card.get("accuracy", {}),
            }
            _write(self.json, record)
        print(generation.table(rows))
        note = too_few_samples(self.count, *reference.held_features.shape)
        if note is not None:
            print(f"\nFrechet distance: {note}.")


def measure(command: EvaluateGeneration) -> tuple[dict[str, Any], str]:
    """The record of a table, and the table as Markdown.

    Raises:
        ValueError, FileNotFoundError: files are missing, damaged or of other networks, or there are too few pictures.
    """
    options, number = command.tables, int(command.tables.table or 1)
    poses = choose_poses([read_motion(path) for path in options.motion], options.poses, 0)
    grid = command.count * options.poses * options.views
    check_counts(*(len(folder_pictures(path)) if path is not None else grid for path in (options.fake, options.real)))
    if options.real is not None:
        reals = folder_images(options.real)
    else:
        seeds = range(options.real_seed, options.real_seed + command.count)
        reals = mesh_images_of_seeds(open_assets(command.assets), seeds, poses, options.views)
    networks = Networks(
        load_pose_depth_network(),
        None if options.inception is None else load_inception(options.inception, options.resize),
        None if options.clip is None else load_clip_vision(options.clip, options.resize),
    )
    model, fps, resolution = None, None, None
    if options.fake is None:
        model = load_checkpoint(command.checkpoint, best_device())
        first = generate(model, command.first_seed, command.steps)
        fps, resolution = frames_per_second(first, MARCH), resolution_of(first)
        fakes = _model_images(model, command, poses)
    else:
        fakes = folder_images(options.fake)
    fake = _scores(fakes, networks, "generated")
    real = _scores(reals, networks, "real")
    rows = compare_pictures(fake, real, options.kid_subsets, options.kid_subset_size, options.kid_seed)
    if fps is not None:
        rows["generated"]["fps"] = fps
    rows["floor"] = reference_cells(networks.own.card)
    choices = _choices(command, fake, real)
    record = {
        "version": __version__,
        "table": number,
        "checkpoint": None if model is None else dict(model.card),
        "choices": choices,
        "resolution": resolution,
        "rows": {row: {name: cell._asdict() for name, cell in cells.items()} for row, cells in rows.items()},
        "remarks": remarks(rows),
        "own_network": networks.own.card,
    }
    return record, table(number, rows, choices, resolution)


def _model_images(model: DiffusionModel, command: EvaluateGeneration, poses: BodyPose) -> Iterator[TestImage]:
    for seed in range(command.first_seed, command.first_seed + command.count):
        human = generate(model, seed, command.steps)
        yield from human_images(human, poses, command.tables.views, f"{seed:06d}", MARCH, best_device())


def _scores(images: Iterator[TestImage], networks: Networks, what: str) -> Scores:
    with tqdm(unit="picture", desc=what, disable=None) as bar:

        def report(done: int) -> None:
            bar.update(done - bar.n)

        return look_at_pictures(images, networks, report)


def _choices(command: EvaluateGeneration, fake: Scores, real: Scores) -> dict[str, Any]:
    """Every choice on which the figures depend."""
    options = command.tables
    rendered = options.fake is None or options.real is None
    grid = f"{options.poses} poses x {options.views} views"
    seeds = f"seeds {command.first_seed} to {command.first_seed + command.count - 1}, {command.steps} steps"
    meshes_seeds = f"meshes of seeds {options.real_seed} to {options.real_seed + command.count - 1}"
    poses = [str(path) for path in options.motion] or "built-in"
    return {
        "picture": f"{SIDE} x {SIDE} pixels over white, sRGB bytes",
        "generated pictures": f"{fake.pictures}: {options.fake or f'{command.count} humans ({seeds}) in {grid}'}",
        "real pictures": f"{real.pictures}: {options.real or f'{meshes_seeds} in {grid}'}",
        "poses": poses if rendered else "of the pictures",
        "marcher step (m)": MARCH.step if options.fake is None else None,
        "resize": f"{options.resize}, to {Inception.SIDE} for Inception and {ClipVision.SIDE} for CLIP",
        "inception": f"pool3, 2048 features, {options.inception}" if options.inception else None,
        "clip": f"image embedding of ViT-B/32, 512 features, {options.clip}" if options.clip else None,
        "KID": f"{options.kid_subsets} subsets of {options.kid_subset_size}, seed {options.kid_seed}, cubic kernel",
        "PCKh": f"within {PCK_SHARE} of the distance {HEAD[0]}-{HEAD[1]} in the picture, occluded joints included; "
        f"{', '.join(JOINTS)}",
        "depth error": "inverted depths inside the human, means and standard deviations aligned, mean squared "
        "difference x 100",
        "FPS": f"median of {FRAMES_TIMED} frames of one placed human on {best_device()}"
        if options.fake is None
        else None,
        "own distance": f"Frechet, {min(fake.pictures, real.pictures // 2)} pictures against as many real ones; "
        "row real: the other real ones",
        "own floor": "PCKh and depth error of our network on renders of meshes held out from its training",
    }


def real_sources(people: Path, assets: Path | None, holdout: float, seed: int) -> tuple[list[Source], list[Source]]:
    """Portraits of the people that a model was trained on, and of those held out: of payloads, or of `assets`' meshes.

    Raises ValueError and FileNotFoundError for people or assets that are missing or unreadable.
    """
    split = split_people(find_people(people), holdout, seed)
    if assets is None:
        train, held = (payload_sources(paths) for paths in split)
        return train, held
    opened = open_assets(assets)
    train, held = (mesh_sources(opened, [read_seed(path) for path in paths], COLOURINGS) for paths in split)
    return train, held


def _write(path: Path, record: Mapping[str, Any]) -> None:
    write_atomically(path, json.dumps(record, indent=1) + "\n")


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    commands: dict[str, Any] = {"reconstruction": EvaluateReconstruction, "generation": EvaluateGeneration}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="primdiffusion evaluate", description=DESCRIPTION, args=arguments or ["--help"]
    ).run()
