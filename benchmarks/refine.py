"""Measures what refining gains on a captured person: PSNR on held-out cameras and in a held-out pose, and time.

`python benchmarks/refine.py --assets DIR --json F` makes one dressed person from a seed that no training set uses,
draws them in nine poses from 24 sides at 256 x 256 with the rasteriser, and refines on eight poses and 21 cameras,
starting from the encoder's human, from `from_mesh` of their mesh, and from the bare grey body. PSNR is of whole
sRGB-encoded pictures, averaged: `heldout_views` are three cameras in the eight poses, `unseen_pose` all cameras in the
ninth. Seconds are wall time and processor time of the steps. `fixed_boxes` figures are of refining with boxes that keep
their sizes, `linear_` figures of the linear solve instead (`render.inverse`), on 84 of the pictures. `--quick` takes 60
steps from the encoder only. `--pictures DIR` saves held-out views side by side, a row for each start: before, after,
target.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image
from primdiffusion.capture.conditioning import CapturedPerson, conditioning_views, default_betas
from primdiffusion.capture.people_files import find_people, read_person
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import Views, open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.commands.reconstruct import ENCODER_VIEWS, split_cameras
from primdiffusion.encoder.model import load_encoder
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, default_frames, place
from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.payloads import rest_frames
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.primitives.from_mesh import FULL_DENSITY, from_mesh
from primdiffusion.reconstruction.from_captures import reconstruct
from primdiffusion.reconstruction.prior_fit import targets_of
from primdiffusion.render.descent import DescentSettings
from primdiffusion.render.inverse import fit_payload
from primdiffusion.render.march import march
from primdiffusion.runtime.device import best_device
from primdiffusion.training.refine import bare_body, refine, view_psnr
from record import command_line, report

SEED = 30_000_000
"""Seed of the person; training sets count from 0."""
POSES, CAMERAS, HELD, SIZE = 9, 24, 3, 256
QUICK_STEPS = 60
LINEAR_PICTURES = 84


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--steps", type=int, default=DescentSettings().steps, help="steps of each refinement")
    parser.add_argument("--seed", type=int, default=SEED, help="seed of the person")
    parser.add_argument("--quick", action="store_true", help="few steps, from the mesh only")
    parser.add_argument("--pictures", type=Path, help="folder for a PNG")
    arguments = parser.parse_args()
    steps = QUICK_STEPS if arguments.quick else arguments.steps
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        assets = open_assets(arguments.assets, required_meshes())
        list(make_people(assets, PeopleSet(folder / "people", arguments.seed, 1), 1))
        (name, path), *_ = find_people(folder / "people").items()
        poses = choose_poses((), POSES, seed=0)
        job = RenderJob({name: path}, poses, folder / "captures", Rig(count=CAMERAS, width=SIZE, height=SIZE),
                  ("img", "mask"))  # fmt: skip
        assert all(outcome.status == "done" for outcome in render(job))
        captures = open_captures(job.out)
        betas = default_betas(captures.subject(name))
        held, given = split_cameras(CAMERAS, HELD)
        sets = [
            [conditioning_views(captures, name, frame, cameras) for frame in frames]
            for frames, cameras in ((range(POSES - 1), given), (range(POSES - 1), held), ((POSES - 1,), None))
        ]
        cameras = tuple(given[:: math.ceil(len(given) / ENCODER_VIEWS)])
        seen = CapturedPerson(name, 0, cameras, conditioning_views(captures, name, 0, cameras), betas, ())
        starts = {"encoder": reconstruct(load_encoder(), seen)}
        if not arguments.quick:
            mesh = from_mesh(read_person(path).mesh, rest_frames(betas.double().numpy()))
            starts |= {"mesh": Human(mesh, betas, {}), "body": bare_body(betas)}
    figures, rows = {"refine_steps": steps}, []
    for source, start in starts.items():
        measured, refined = measure(start.to(best_device()), *sets, steps)
        figures |= {f"{figure}_from_{source}": value for figure, value in measured.items()}
        rows.append(compared((start, refined), [sets[1][0], sets[1][4], sets[2][0]]))
    fixed = refine(starts["encoder"], sets[0], DescentSettings(steps=steps, scale_rate=0)).human
    figures |= {
        "refine_psnr_heldout_views_fixed_boxes": mean_psnr(fixed, sets[1]),
        "refine_psnr_unseen_pose_fixed_boxes": mean_psnr(fixed, sets[2]),
    }
    figures |= linear(starts["encoder"], sets[0], sets[1], sets[2])
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        pixels = (torch.cat(rows).cpu() * 255).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).save(arguments.pictures / "refine.png")
    report(figures, arguments.json)


def measure(
    start: Human, given: list[Views], held: list[Views], unseen: list[Views], steps: int
) -> tuple[dict[str, float], Human]:
    """Figures of one refinement, and its person. A step beforehand compiles the marcher."""
    refine(start, given[:1], DescentSettings(steps=1))
    moments = []

    def note() -> None:
        moments.append((time.perf_counter(), time.process_time()))

    note()
    refined = refine(start, given, DescentSettings(steps=steps), note).human
    figures = {
        "refine_psnr_start": mean_psnr(start, held),
        "refine_psnr_heldout_views": mean_psnr(refined, held),
        "refine_psnr_unseen_pose_start": mean_psnr(start, unseen),
        "refine_psnr_unseen_pose": mean_psnr(refined, unseen),
        "refine_seconds_cpu": moments[-1][0] - moments[0][0],
        "refine_processor_seconds": moments[-1][1] - moments[0][1],
    }
    return figures, refined


def linear(start: Human, given: list[Views], held: list[Views], unseen: list[Views]) -> dict[str, float]:
    """Figures of the linear solve, with LINEAR_PICTURES of the given ones; boxes keep their sizes."""
    targets = []
    for views in given:
        frames = [default_frames(start.betas, views.pose)] * len(views.rgba)
        targets += targets_of(views, frames, SIZE)
    targets = targets[:: math.ceil(len(targets) / LINEAR_PICTURES)]
    fit_payload(start.payload, targets[:1], FULL_DENSITY)  # compiles the marcher
    began = time.perf_counter()
    solved = dataclasses.replace(start, payload=fit_payload(start.payload, targets, FULL_DENSITY))
    return {
        "linear_seconds_cpu": time.perf_counter() - began,
        "linear_psnr_heldout_views": mean_psnr(solved, held),
        "linear_psnr_unseen_pose": mean_psnr(solved, unseen),
    }


def mean_psnr(human: Human, views: Sequence[Views]) -> float:
    """The mean over all pictures, in dB."""
    return float(view_psnr(human, views).mean())


@torch.no_grad()
def compared(people: Sequence[Human], views: Sequence[Views]) -> torch.Tensor:
    """The first picture of each record, of each person and then of the target, in one row; sRGB-encoded [H, W, 3]."""
    columns = []
    for record in views:
        camera = record.camera.map(lambda values: values[0])
        drawn = [march(place(person.to("cpu"), record.pose), camera).rgb for person in people]
        columns += [*(encode_srgb(rgb).clamp(0, 1) for rgb in drawn), record.image[0] / 255]
    return torch.cat(columns, dim=1)


if __name__ == "__main__":
    main()
