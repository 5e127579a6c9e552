"""Measures reconstruction by the person prior from one view: what it shows, what it does not, and whose human it is.

`python benchmarks/from_pictures.py --assets DIR --json F --sheet F.png` makes dressed humans from seeds that no
training set uses and draws their meshes from 32 sides with the rasteriser, every second human in another pose than T.
Each is reconstructed from the front view alone, and from more. Means over humans, of sRGB-encoded pictures over grey,
over the figure and 8 pixels around it:

    one_view_psnr, one_view_ssim    eight views that no reconstruction was given
    eight_views_psnr                the same, from eight views
    frames_N_psnr                   the same, from N frames of a turntable
    one_view_seen_psnr              the front view, which was given
    one_view_seen_gap_db            that from eight views, less that from one
    identity_rate                   humans whose unseen views are nearer to their own pictures than to anyone else's

The sheet has a row for each human: the given view, then two others beside the true ones.

`python benchmarks/from_pictures.py baselines --assets DIR --json F` adds the same PSNR by two baselines:

    encoder_psnr     `reconstruct` by the encoder, from the front view
    mirrored_psnr    the mean human with the front view and its mirror image as its back

`python benchmarks/from_pictures.py seconds --assets DIR --json F` adds one_view_seconds_cpu to the figures in F, the
mean CPU time of a reconstruction from one view.

`python benchmarks/from_pictures.py distance --assets DIR --json F` adds how real the sides look that the view does not
show: their kernel distance to those sides of the humans' own meshes, over that of generated humans' sides to held-out
meshes'. Back and left portraits in T pose are compared, in the feature space of `primdiffusion.evaluation`, by a
network of these two (`python -m scripts.train_attribute_network --reference DIR --assets DIR --only back left`).
Distances of some 30 humans to other people depend more on who they are than on how real they look; that to their own
meshes does not (`distance_in_pairs`), and generated humans are many. Portraits of meshes stay in the folder
--reference, which benchmarks/diffusion.py uses as well.

    one_view_unseen_distance_ratio          of reconstructions, whose unseen sides are the most probable ones
    one_view_drawn_unseen_distance_ratio    of those with a seed, whose unseen sides are drawn
    ..._unseen_distance                     the distances themselves
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from diffusion_sets import generated
from figure_metrics import figure_psnr
from jaxtyping import Float, UInt8
from PIL import Image
from primdiffusion.capture.conditioning import CapturedPerson, conditioning_views, default_betas
from primdiffusion.capture.people_files import find_people
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import Captures, Views, open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import load_encoder
from primdiffusion.evaluation.metrics import cubic_kernel, kernel_distance, ssim
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.human import Human, default_frames, place
from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.reconstruction.from_captures import reconstruct
from primdiffusion.reconstruction.prior_fit import PriorFit, targets_of
from primdiffusion.render.inverse import fit_payload
from primdiffusion.render.march import march
from record import command_line, report, run, surroundings
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.feature_space.comparison import PORTRAITS_FOLDER
from scripts.feature_space.network import features_of, load_attribute_network
from scripts.feature_space.portraits import COLOURINGS, PORTRAITS, made_gallery, mesh_sources, open_gallery

SEED = 31_000_000
"""Seed of the first human; training sets count from 0."""
HELD_SEED = 10_000_000
"""Seed of the first mesh that generated and reconstructed humans are compared with."""
CAMERAS, SIZE, POSES = 32, 512, 2
FRAMES, EIGHT = (1, 4, 16), 8
GREY = decode_srgb(torch.tensor(0.5))
VIEW = 256
"""Pixels a side of the sheet's pictures."""


class Case(NamedTuple):
    """A captured human."""

    by_frames: Mapping[int, CapturedPerson]
    """From so many sides, evenly spaced, the first of which is the front."""
    unseen: Views
    """From sides between them."""

    @property
    def given(self) -> CapturedPerson:
        return self.by_frames[1]


def main() -> None:
    parser = options(people=32)
    parser.add_argument("--sheet", type=Path, help="PNG of the first eight humans")
    arguments = parser.parse_args()
    model = load_checkpoint(arguments.checkpoint)
    rows: list[dict[str, float]] = []
    drawn, true, sheet = [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        captures = captured(Path(scratch), arguments.assets, arguments.people)
        for number, name in enumerate(captures.subjects):
            case = case_of(captures, name, number % POSES)
            many = {count: reconstruct(model, person) for count, person in case.by_frames.items()}
            one = many[1]
            pictures, targets = pictures_of(one, case.unseen), over_grey(case.unseen)
            seen = [psnr_of(human, case.given.views) for human in (one, many[EIGHT])]
            rows.append({
                "one_view_psnr": psnr_of(one, case.unseen),
                "one_view_ssim": float(ssim(pictures, targets).mean()),
                "eight_views_psnr": psnr_of(many[EIGHT], case.unseen),
                **{f"frames_{count}_psnr": psnr_of(many[count], case.unseen) for count in FRAMES},
                "one_view_seen_psnr": seen[0],
                "one_view_seen_gap_db": seen[1] - seen[0],
            })  # fmt: skip
            print(name, {key: round(value, 2) for key, value in rows[-1].items()}, flush=True)
            drawn.append(small(pictures))
            true.append(small(targets))
            if number < 8:
                front = over_grey(case.given.views)[0]
                sheet.append(torch.cat([front, pictures[1], targets[1], pictures[3], targets[3]], 1))
    figures: dict[str, float | int] = {key: round(float(np.mean([row[key] for row in rows])), 4) for key in rows[0]}
    distance = torch.cdist(torch.stack(drawn), torch.stack(true))
    figures["identity_rate"] = float((distance.argmin(1) == torch.arange(len(rows))).float().mean())
    figures["people"] = len(rows)
    if arguments.sheet is not None:
        pixels = (255 * torch.cat(sheet)).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).resize((5 * VIEW, len(sheet) * VIEW), Image.Resampling.BOX).save(arguments.sheet)
    report(figures, arguments.json)


def baselines() -> None:
    arguments = options(people=32).parse_args()
    model, encoder = load_checkpoint(arguments.checkpoint), load_encoder(None, torch.device("cpu"))
    rows: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory() as scratch:
        captures = captured(Path(scratch), arguments.assets, arguments.people)
        for number, name in enumerate(captures.subjects):
            case = case_of(captures, name, number % POSES)
            humans = reconstruct(encoder, case.given), by_mirror(model, case.given)
            rows.append((psnr_of(humans[0], case.unseen), psnr_of(humans[1], case.unseen)))
    encoder_psnr, mirrored_psnr = (round(float(mean), 4) for mean in np.mean(rows, axis=0))
    add({"encoder_psnr": encoder_psnr, "mirrored_psnr": mirrored_psnr}, arguments.json)


def seconds() -> None:
    arguments = options(people=8).parse_args()
    model, taken = load_checkpoint(arguments.checkpoint), []
    with tempfile.TemporaryDirectory() as scratch:
        captures = captured(Path(scratch), arguments.assets, arguments.people)
        cases = [case_of(captures, name, number % POSES) for number, name in enumerate(captures.subjects)]
        reconstruct(model, cases[0].given)  # compiles the marcher
        for case in cases:
            began = time.process_time()
            reconstruct(model, case.given)
            taken.append(time.process_time() - began)
    add({"one_view_seconds_cpu": round(float(np.mean(taken)), 4)}, arguments.json)


def distance() -> None:
    parser = options(people=32)
    parser.add_argument("--reference", type=Path, default=Path("runs/reference"), help="folder for portraits of meshes")
    parser.add_argument("--meshes", type=int, default=160, help="geometries of the network; half as many are held out")
    parser.add_argument("--generated", type=int, default=128, help="generated humans")
    arguments = parser.parse_args()
    model = load_checkpoint(arguments.checkpoint)
    assets = open_assets(arguments.assets, required_meshes())
    held, own = (
        open_gallery(mesh_sources(assets, range(first, first + count), each), arguments.reference / PORTRAITS_FOLDER)
        for first, count, each in ((HELD_SEED, arguments.meshes // 2, COLOURINGS), (SEED, arguments.people, 1))
    )
    network = load_attribute_network(arguments.reference / "features_back_left.safetensors")

    def features(pictures: UInt8[Tensor, "n v h w 4"]) -> Float[Tensor, "n f"]:
        return features_of(network, unseen_sides(pictures))

    def distance_of(humans: Iterable[Human]) -> float:
        return distance_in_pairs(features(made_gallery(place(human) for human in humans)), features(own.pictures))

    with tempfile.TemporaryDirectory() as scratch:
        captures = captured(Path(scratch), arguments.assets, arguments.people)
        cases = [case_of(captures, name, number % POSES).given for number, name in enumerate(captures.subjects)]
        pictures = made_gallery(place(human) for human in generated(model, range(arguments.generated)))
        made = kernel_distance(features(pictures), features(held.pictures))
        probable = distance_of(reconstruct(model, case) for case in cases)
        drawn = distance_of(reconstruct(model, case, seed=seed) for seed, case in enumerate(cases))
    figures = {
        "one_view_unseen_distance": round(probable, 4),
        "one_view_drawn_unseen_distance": round(drawn, 4),
        "generated_unseen_distance": round(made, 4),
        "one_view_unseen_distance_ratio": round(probable / made, 4),
        "one_view_drawn_unseen_distance_ratio": round(drawn / made, 4),
    }
    add(figures, arguments.json)


def distance_in_pairs(first: Float[Tensor, "n f"], second: Float[Tensor, "n f"]) -> float:
    """`kernel_distance` of samples that belong together in pairs: its unbiased estimate without the pairs' products.

    Gretton et al. 2012, eq. 4. What both have in common, such as who the people are, cancels.
    """
    first, second = first.double(), second.double()
    between = cubic_kernel(first, second)
    table = cubic_kernel(first, first) + cubic_kernel(second, second) - between - between.T
    return float((table.sum() - table.trace()) / (len(table) * (len(table) - 1)))


def unseen_sides(portraits: UInt8[Tensor, "n v h w 4"]) -> UInt8[Tensor, "n v h w 4"]:
    """The back and the left in place of all portraits, as many as the network takes."""
    back, left = (next(i for i, one in enumerate(PORTRAITS) if one.name == name) for name in ("back", "left"))
    return portraits[:, [back, left] * (len(PORTRAITS) // 2)]


def add(figures: dict[str, float], path: Path | None) -> None:
    """Print the figures, and add them to the record if a path is given."""
    if path is not None and path.exists():
        known = json.loads(path.read_text(encoding="utf-8"))
        figures = {name: value for name, value in known.items() if name not in surroundings()} | figures
    report(figures, path)


def options(people: int) -> argparse.ArgumentParser:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--checkpoint", type=Path, help="diffusion model; the default one if omitted")
    parser.add_argument("--people", type=int, default=people)
    return parser


def captured(folder: Path, assets: Path | None, count: int) -> Captures:
    """Render dressed humans as a dataset of captures."""
    list(make_people(open_assets(assets, required_meshes()), PeopleSet(folder / "people", SEED, count), 1))
    rig = Rig(count=CAMERAS, elevations=(5.0,), width=SIZE, height=SIZE)
    people = dict(find_people(folder / "people").items())
    job = RenderJob(people, choose_poses((), POSES, seed=0), folder / "captures", rig, ("img", "mask"))
    assert all(outcome.status == "done" for outcome in render(job))
    return open_captures(job.out)


def case_of(captures: Captures, name: str, frame: int) -> Case:
    subject = captures.subject(name)
    front = max(range(CAMERAS), key=lambda camera: subject.views[camera].position[2])

    def around(count: int, first: int = 0) -> list[int]:
        return [(front + first + step) % CAMERAS for step in range(0, CAMERAS, CAMERAS // count)]

    def person(cameras: Sequence[int]) -> CapturedPerson:
        views = conditioning_views(captures, name, frame, cameras)
        return CapturedPerson(name, frame, tuple(cameras), views, default_betas(subject), ())

    by_frames = {count: person(around(count)) for count in (*FRAMES, EIGHT)}
    return Case(by_frames, conditioning_views(captures, name, frame, around(EIGHT, first=1)))


def by_mirror(model: DiffusionModel, person: CapturedPerson) -> Human:
    """Fit the mean human's voxels to the front view, and to its mirror image seen from the opposite side."""
    views, components = person.views, PriorFit.of(model)
    frames = default_frames(person.betas, views.pose)
    turned = views.camera.world_to_camera @ half_turn_about(frames.position.mean(0))
    intrinsics = views.camera.intrinsics.clone()
    intrinsics[..., 0, 2] = views.camera.width - intrinsics[..., 0, 2]
    camera = dataclasses.replace(views.camera, intrinsics=intrinsics, world_to_camera=turned)
    back = dataclasses.replace(views, rgba=views.rgba.flip(2), camera=camera)
    targets = [target for side in (views, back) for target in targets_of(side, [frames], SIZE)]
    mean_human = components.payload(components.coefficients(components.everyone()))
    payload = fit_payload(mean_human, targets, components.full_density)
    return Human(payload, person.betas, {})


def half_turn_about(point: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """Rotation by 180 degrees about the vertical (y) through a point."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    turn[0, 3], turn[2, 3] = 2 * point[0], 2 * point[2]
    return turn


def over_grey(views: Views) -> Float[Tensor, "v H W 3"]:
    """The true pictures, encoded."""
    alpha = views.mask[..., None] / 255
    return encode_srgb((decode_srgb(views.image / 255) + (1 - alpha) * GREY).clamp(0, 1))


@torch.no_grad()
def pictures_of(human: Human, views: Views) -> Float[Tensor, "v H W 3"]:
    """The human in the pose and from the cameras of the views, likewise."""
    primitives, drawn = place(human, views.pose), []
    for number in range(len(views.rgba)):
        seen = march(primitives, views.camera.map(lambda values, number=number: values[number]))
        drawn.append(encode_srgb((seen.rgb + (1 - seen.alpha[..., None]) * GREY).clamp(0, 1)))
    return torch.stack(drawn)


def psnr_of(human: Human, views: Views) -> float:
    pairs = zip(pictures_of(human, views), over_grey(views), views.mask > 127, strict=True)
    return float(torch.stack([figure_psnr(*pair) for pair in pairs]).mean())


def small(pictures: Float[Tensor, "v H W 3"]) -> Float[Tensor, "d"]:
    """Pictures at an eighth of their size, to compare whole humans."""
    return torch.nn.functional.avg_pool2d(pictures.movedim(-1, 1), 8).flatten()


if __name__ == "__main__":
    run(main, baselines=baselines, seconds=seconds, distance=distance)
