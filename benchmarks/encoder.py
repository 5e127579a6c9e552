"""Quality and speed of the encoder on training people and held-out people, beside the paper's Table 3.

`python benchmarks/encoder.py --train CAPTURES --heldout CAPTURES --models DIR --json encoder.json --table encoder.md`
evaluates those of the checkpoints full, shared_scale, template_rt, no_attention and full_at_equal_steps (.safetensors)
that the folder contains; without --models, the package's encoder. Each person is encoded from eight views of one pose
and compared in all views (or --cameras of them) and poses at 512 x 512; figures with `_novel` are of views and poses
that the encoder was not given. As in the paper, psnr_shared_scale and similar figures are of training people. Without
capture folders, held-out people are made from MakeHuman's assets (--assets), with seeds that training does not use.
--quick evaluates one person. Times are the best or median of several; names with `processor` are processor time, the
others wall time.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from encoder_speed import VIEWS, reconstruct_seconds, step_seconds
from march import from_script
from primdiffusion.capture.people_files import find_people
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import Captures, open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.encoder.model import EncoderModel, load_encoder
from primdiffusion.evaluation.image_metrics import Lpips, load_lpips
from primdiffusion.evaluation.reconstruction import EvaluationSettings, Means, evaluate, summary, table
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.wardrobe import required_meshes
from record import command_line, report

FIRST_SEED = 30_000_000
"""Seed of the first person made here; training sets count from 0."""
PEOPLE, POSES, CAMERAS = 6, 4, 12
REFINE_FIGURES = ("refine_psnr_heldout_views", "refine_seconds_cpu")
Figures = dict[str, float | int | str | None]


class Variant(NamedTuple):
    """A row of the table: one checkpoint."""

    name: str
    """File name of its checkpoint, without the suffix."""
    title: str
    paper: tuple[float, float, float] | None
    """PSNR, SSIM and LPIPS from the paper's Table 3: training people, all views and poses."""


VARIANTS = (
    Variant("full", "full model", (32.15, 0.984, 0.048)),
    Variant("full_at_equal_steps", "full model, as many steps as those below", None),
    Variant("shared_scale", "one delta scale for all boxes", (18.35, 0.803, 0.182)),
    Variant("template_rt", "frames of the template body", (31.70, 0.982, 0.058)),
    Variant("no_attention", "without attention", (28.39, 0.962, 0.081)),
)


class Quality(NamedTuple):
    """A checkpoint's means on both sets of people; None if there is no such set."""

    train: dict[str, Means] | None
    heldout: dict[str, Means] | None
    steps: int | None
    people: int | None


def main() -> None:
    arguments = parsed()
    with tempfile.TemporaryDirectory() as scratch:
        sets = {name: getattr(arguments, name) for name in ("train", "heldout")}
        if sets == {"train": None, "heldout": None}:
            sets["heldout"] = made_people(Path(scratch), arguments.assets, 1 if arguments.quick else PEOPLE)
        captures = {name: None if root is None else open_captures(root) for name, root in sets.items()}
        lpips = load_lpips(arguments.lpips) if arguments.lpips else None
        models = read_models(arguments.models)
        qualities = {
            name: Quality(
                *(measured(model, captures[one], arguments, lpips) for one in ("train", "heldout")),
                model.card.get("steps"),
                model.card.get("people"),
            )
            for name, model in models.items()
        }
        some = captures["heldout"] or captures["train"]
        assert some is not None
        figures = quality_figures(qualities)
        if "full" in models:
            figures |= reconstruct_seconds(models["full"], some, 2 if arguments.quick else 7)
        figures |= step_seconds(some, 2 if arguments.quick else 8)
    if arguments.quick or arguments.without_refine:
        figures |= dict.fromkeys(REFINE_FIGURES)
    else:
        assets = () if arguments.assets is None else ("--assets", str(arguments.assets))
        figures |= from_script("refine.py", REFINE_FIGURES, *assets)
    report(figures, arguments.json)
    text = table_of(qualities)
    print(text)
    if arguments.table is not None:
        arguments.table.write_text(text + "\n", encoding="utf-8")


def parsed() -> argparse.Namespace:
    parser = command_line(__doc__)
    parser.add_argument("--train", type=Path, help="captures of people that the encoder was trained on")
    parser.add_argument("--heldout", type=Path, help="captures of other people")
    parser.add_argument("--models", type=Path, help="folder of checkpoints; without it, the package's encoder")
    parser.add_argument("--people", type=int, default=16, help="number of people from each set, evenly spaced")
    parser.add_argument("--cameras", type=int, help="number of cameras to compare in, evenly spaced; without it, all")
    parser.add_argument("--lpips", type=Path, nargs="*", default=(), help="files with the weights of LPIPS")
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--without-refine", action="store_true", help="skip benchmarks/refine.py")
    parser.add_argument("--quick", action="store_true", help="one person, two poses")
    parser.add_argument("--table", type=Path, help="markdown file for the tables")
    return parser.parse_args()


def made_people(folder: Path, assets: Path | None, count: int) -> Path:
    """Captures of `count` people that are in no training set, from other directions than the default rig's."""
    for _ in make_people(open_assets(assets, required_meshes()), PeopleSet(folder / "people", FIRST_SEED, count), 1):
        pass
    rig = Rig(count=CAMERAS, elevations=(5.0, 30.0))
    job = RenderJob(
        find_people(folder / "people"), choose_poses([], POSES, 0), folder / "heldout", rig, ("img", "mask")
    )
    failed = [outcome.error for outcome in render(job) if outcome.status == "failed"]
    assert not failed, failed
    return job.out


def read_models(folder: Path | None) -> dict[str, EncoderModel]:
    """The checkpoints that exist in the folder."""
    if folder is None:
        return {"full": load_encoder()}
    paths = {variant.name: folder / f"{variant.name}.safetensors" for variant in VARIANTS}
    return {name: load_encoder(path) for name, path in paths.items() if path.is_file()}


def measured(
    model: EncoderModel, captures: Captures | None, arguments: argparse.Namespace, lpips: Lpips | None
) -> dict[str, Means] | None:
    """Means over each part of a set's pictures."""
    if captures is None:
        return None
    count = 1 if arguments.quick else min(arguments.people, len(captures.subjects))
    names = tuple(captures.subjects[i * len(captures.subjects) // count] for i in range(count))
    every = len(captures.subject(names[0]).views)
    count = min(arguments.cameras or every, every)
    settings = EvaluationSettings(
        names,
        frames=(0, 1) if arguments.quick else (),
        cameras=tuple(i * every // count for i in range(count)),
        given_views=VIEWS,
    )
    return summary(evaluate(model, captures, settings, lpips))


def quality_figures(qualities: dict[str, Quality]) -> Figures:
    """Figures by name: the full model's in detail, the others' PSNR and SSIM; None where not measured."""
    figures: Figures = {}
    for variant in VARIANTS:
        quality = qualities.get(variant.name, Quality(None, None, None, None))
        suffix = "" if variant.name == "full" else f"_{variant.name}"
        for people, means in (("train", quality.train), ("heldout", quality.heldout)):
            for metric in ("psnr", "ssim"):
                figures[f"{metric}{suffix}_{people}"] = _mean(means, "all", metric)
                figures[f"{metric}{suffix}_{people}_novel"] = _mean(means, "novel_views_novel_poses", metric)
            if not suffix:
                names = ("lpips", "psnr_box", "ssim_box", "mask_iou", "pictures")
                figures |= {f"{name}_{people}": _mean(means, "all", name) for name in names}
        if suffix:
            figures[f"psnr{suffix}"] = figures.pop(f"psnr{suffix}_train")
        figures |= {f"steps{suffix}": quality.steps, f"people{suffix}": quality.people}
    return figures


def _mean(means: dict[str, Means] | None, part: str, figure: str) -> float | int | None:
    return None if means is None else getattr(means[part], figure)


def table_of(qualities: dict[str, Quality]) -> str:
    """The paper's Table 3 beside ours, then the full model's parts."""
    lines = [
        "| model | paper PSNR | SSIM | LPIPS | ours, trained on: PSNR | SSIM | held out: PSNR | SSIM "
        "| novel views and poses: PSNR | SSIM | steps | people |",
        "|---" * 12 + "|",
    ]
    for variant in VARIANTS:
        quality = qualities.get(variant.name)
        cells: list[object] = [None] * 8
        if quality is not None:
            parts = [(quality.train, "all"), (quality.heldout, "all"), (quality.heldout, "novel_views_novel_poses")]
            pairs = [(_mean(*part, "psnr"), _mean(*part, "ssim")) for part in parts]
            cells = [cell for p, s in pairs for cell in (p and f"{p:.2f}", s and f"{s:.4f}")]
            cells += [quality.steps, quality.people]
        paper: Sequence[object] = (None,) * 3
        if variant.paper is not None:
            paper = [f"{value:.{digits}f}" for value, digits in zip(variant.paper, (2, 3, 3), strict=True)]
        lines.append(f"| {variant.title} | {' | '.join('-' if c is None else str(c) for c in (*paper, *cells))} |")
    full = qualities.get("full")
    for title, means in (("People trained on", full and full.train), ("People held out", full and full.heldout)):
        if means:
            lines += ["", f"{title}, full model:", "", table(means)]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
