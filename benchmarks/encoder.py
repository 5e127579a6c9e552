"""Quality and speed of the encoder on training people and held-out people, beside the paper's Table 3.

`python benchmarks/encoder.py --train CAPTURES --heldout CAPTURES --models DIR --json encoder.json --table encoder.md`
evaluates those of the checkpoints full, shared_scale, template_rt, no_attention and full_at_equal_steps (.safetensors)
that the folder contains; without --models, the package's encoder, and beside it one that is untrained. Each person is
encoded from eight views of one pose and compared in all views (or --cameras of them) and poses at 512 x 512; figures
with `_novel` are of views and poses that the encoder was not given; those with `_descended` are of the encoder followed
by gradient descent on the eight views, as in `reconstruct`; those with `_refined` are of `refine` on the very images of
held-out people that are compared, the limit of the boxes. As in the paper,
psnr_shared_scale and similar figures are of training people. Without capture folders, held-out people are made from
MakeHuman's assets (--assets), with seeds that training does not use. --quick evaluates one person. Times are the best
or median of several; names with `processor` are processor time, the others wall time.

`encoder.py curve --metrics docs/results/encoder_metrics.jsonl --plot docs/pictures/encoder_curve.png` plots PSNR on
training and held-out people by step from a run's metrics.jsonl, and prints the gain of the last doubling of the steps,
an upper bound for the gain of another doubling.

`encoder.py pictures --train CAPTURES --heldout CAPTURES --out docs/pictures/encoder.png` draws a row for each person,
not hand-picked: one of the eight views that `reconstruct` was given and its result; a view and a pose that it was
not given, each beside the captured picture; the novel pose's depth and primitives.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from march import best_ms
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from primdiffusion.body.model import BodyModel, BodyPose
from primdiffusion.capture.conditioning import captured_person, conditioning_views, default_betas, spread_cameras
from primdiffusion.capture.dataset import batches
from primdiffusion.capture.people_files import find_people
from primdiffusion.capture.poses import choose_poses
from primdiffusion.capture.reader import Captures, Views, open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.drawing import Scene, ViewSettings, draw
from primdiffusion.encoder.model import EncoderModel, load_encoder, unproject_views
from primdiffusion.encoder.network import Encoder
from primdiffusion.evaluation.metrics import Lpips, load_lpips
from primdiffusion.evaluation.reconstruction import (
    EvaluationSettings,
    Means,
    PictureScore,
    evaluate,
    summary,
    table,
)
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.people.assets import open_assets
from primdiffusion.people.folder import PeopleSet, make_people
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.reconstruction.from_captures import encode_and_fit, reconstruct
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_data import FitSample, fit_dataset
from primdiffusion.training.fit_losses import loss_terms
from primdiffusion.training.refine import refine
from record import command_line, report, run
from torch import Tensor

FIRST_SEED = 30_000_000
"""Seed of the first person made here; training sets count from 0."""
PEOPLE, POSES, CAMERAS = 6, 4, 12
REFINED_PEOPLE = 6
Figures = dict[str, float | int | str | None]
VIEWS = 8
PARTS = ("data", "forward", "march", "march_backward", "backward", "update")
"""The parts of a step. `march` includes the loss, a small share; `backward` is the network's alone."""

SETS = {"psnr_train": "training people", "psnr_held": "people held out"}
SIZE = 512
MARGIN = 0.06
"""Margin on each side of the person, as a share of the cropped square's side."""
COLUMNS = (
    "given view (1 of 8)", "reconstruction", "novel view", "captured", "novel pose", "captured", "depth", "primitives"
)  # fmt: skip
HEADING, NAME = 26, 22
"""Height of the heading row and width of the name column, in pixels."""
INK, PAPER = (235, 235, 235), (0, 0, 0)


class Variant(NamedTuple):
    """A row of the table: one checkpoint."""

    name: str
    """File name of its checkpoint, without the suffix."""
    title: str
    paper: tuple[float, float, float] | None
    """PSNR, SSIM and LPIPS from the paper's Table 3: training people, all views and poses."""


VARIANTS = (
    Variant("full", "full model", (32.15, 0.984, 0.048)),
    Variant("descended", "full model, then gradient descent, as in `reconstruct`", None),
    Variant("untrained", "untrained: the hull of the masks", None),
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
        models: dict[str, EncoderModel | Descended] = {**read_models(arguments.models)}
        if "full" in models:
            models["descended"] = Descended(models["full"])
            torch.manual_seed(0)
            models["untrained"] = EncoderModel(Encoder(models["full"].config).eval().requires_grad_(False), {})
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
        if captures["heldout"] is not None and "full" in models and not arguments.quick:
            figures |= refined_figures(models["full"], captures["heldout"], min(arguments.people, REFINED_PEOPLE))
        if "full" in models:
            figures |= reconstruct_seconds(models["full"], some, 2 if arguments.quick else 7)
        figures |= step_seconds(some, 2 if arguments.quick else 8)
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
    model: EncoderModel | Descended, captures: Captures | None, arguments: argparse.Namespace, lpips: Lpips | None
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


def refined_figures(model: EncoderModel, captures: Captures, count: int) -> Figures:
    """Means over all images of humans that were refined on these images."""
    scores: list[PictureScore] = []
    for number in range(count):
        name = captures.subjects[number * len(captures.subjects) // count]
        subject = captures.subject(name)
        person = captured_person(captures.root, name, 0, VIEWS)
        views = [conditioning_views(captures, name, frame, None, SIZE) for frame in range(subject.frames)]
        payload = refine(reconstruct(model, person), views).human.payload
        scores += evaluate(Known(model, payload), captures, EvaluationSettings((name,), given_views=VIEWS, size=SIZE))
    means = summary(scores)["all"]
    figures = {f"{name}_refined": means[name] for name in ("psnr", "ssim", "mask_iou")}
    return {**figures, "people_refined": count}


class Descended(NamedTuple):
    """An encoder followed by gradient descent on the images."""

    model: EncoderModel

    @property
    def body(self) -> BodyModel:
        return self.model.body

    @property
    def card(self) -> Mapping[str, Any]:
        return self.model.card

    def encode(self, views: Views, betas: Tensor) -> Payload:
        return encode_and_fit(self.model, views, betas)

    def place(self, payload: Payload, betas: Tensor, pose: BodyPose) -> Primitives:
        return self.model.place(payload, betas, pose)


class Known(NamedTuple):
    """An encoder whose answer is known."""

    model: EncoderModel
    payload: Payload

    @property
    def body(self) -> BodyModel:
        return self.model.body

    def encode(self, views: Views, betas: Tensor) -> Payload:
        return self.payload

    def place(self, payload: Payload, betas: Tensor, pose: BodyPose) -> Primitives:
        return self.model.place(payload, betas, pose)


def quality_figures(qualities: dict[str, Quality]) -> Figures:
    """Figures by name: the full model's in detail, others' PSNR and SSIM; None where not measured."""
    figures: Figures = {}
    for variant in VARIANTS:
        if variant.name not in qualities:
            continue
        quality = qualities[variant.name]
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
    return None if means is None else means[part][figure]


def table_of(qualities: dict[str, Quality]) -> str:
    """The paper's Table 3 beside ours, then the full model's parts."""
    lines = [
        "| model | paper PSNR | SSIM | LPIPS | ours, trained on: PSNR | SSIM | held out: PSNR | SSIM "
        "| novel views and poses: PSNR | SSIM | steps | people |",
        "|---" * 12 + "|",
    ]
    for variant in VARIANTS:
        if variant.name not in qualities:
            continue
        quality = qualities[variant.name]
        parts = [(quality.train, "all"), (quality.heldout, "all"), (quality.heldout, "novel_views_novel_poses")]
        pairs = [(_mean(*part, "psnr"), _mean(*part, "ssim")) for part in parts]
        cells: list[object] = [cell for p, s in pairs for cell in (p and f"{p:.2f}", s and f"{s:.4f}")]
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


def reconstruct_seconds(model: EncoderModel, captures: Captures, repeats: int) -> dict[str, float]:
    """Seconds from eight 512 x 512 views in memory to a payload: the fastest of several runs, and its parts."""
    person = captured_person(captures.root, captures.subjects[0], 0, VIEWS)

    def whole() -> Payload:
        return encode_and_fit(model, person.views, person.betas)

    def encode() -> Payload:
        return model.encode(person.views, person.betas)

    def unproject() -> object:
        return unproject_views(model.config, person.views, person.betas)

    whole()
    figures = {}
    for name, clock in (("", time.perf_counter), ("processor_", time.process_time)):
        total, encoded, looked_up = (best_ms(call, repeats, clock) / 1e3 for call in (whole, encode, unproject))
        figures |= {
            f"reconstruct_{name}seconds_cpu": total,
            f"reconstruct_unproject_{name}seconds_cpu": looked_up,
            f"reconstruct_forward_{name}seconds_cpu": max(encoded - looked_up, 0.0),
            f"reconstruct_descent_{name}seconds_cpu": max(total - encoded, 0.0),
        }
    return figures


def step_seconds(captures: Captures, steps: int) -> dict[str, float | int]:
    """Processor seconds of the parts of a training step with the default settings: medians of `steps` steps."""
    config = FitConfig(data=captures.root, run=Path("unused"))
    torch.manual_seed(0)
    encoder = Encoder(config.architecture).train()
    optimiser = torch.optim.AdamW(encoder.parameters(), config.learning_rate)
    stream = batches(fit_dataset(captures, config), config.batch)
    taken: list[dict[str, float]] = []
    for _ in range(steps + 1):
        seconds: dict[str, float] = {}
        _step(config, encoder, optimiser, lambda: next(stream)[0], seconds)
        taken.append(seconds)
    medians = {part: statistics.median(seconds[part] for seconds in taken[1:]) for part in PARTS}  # first: warm-up
    total = sum(medians.values())
    share = (medians["march"] + medians["march_backward"]) / total
    figures: dict[str, float | int] = {f"step_{part}_processor_seconds": medians[part] for part in PARTS}
    about = {"step_people": config.batch, "step_pictures": config.batch * config.targets, "step_size": config.size}
    return figures | about | {"step_processor_seconds": total, "step_marcher_share": share}


def _step(
    config: FitConfig,
    encoder: Encoder,
    optimiser: torch.optim.Optimizer,
    read: Callable[[], FitSample],
    seconds: dict[str, float],
) -> None:
    """One step, split at the boxes that are marched: the marcher's adjoint is timed separately from the network's."""

    @contextmanager
    def timed(part: str) -> Iterator[None]:
        began = time.process_time()
        yield
        seconds[part] = time.process_time() - began

    with timed("data"):
        sample = read()
    with timed("forward"):
        made = Primitives.place(sample.frames, encoder(sample.found, sample.axis_angle))
    boxes = made.map(lambda tensor: tensor.detach().requires_grad_(tensor.requires_grad))
    with timed("march"):
        people = boxes.map(lambda tensor: tensor[:, None])
        drawn = march(people, sample.target.camera, MarchSettings(step=config.step))
        target, mask = (values.float() / 255 for values in (sample.target.image, sample.target.mask))
        terms = loss_terms(encode_srgb(drawn.rgb), drawn.alpha, boxes.half_extent, target, mask, config.loss)
        total = torch.stack(list(terms.values())).sum()
    with timed("march_backward"):
        total.backward()
    with timed("backward"):
        names = [name for name, tensor in vars(made).items() if tensor.requires_grad]
        torch.autograd.backward([getattr(made, name) for name in names], [getattr(boxes, name).grad for name in names])
    with timed("update"):
        optimiser.step()
        optimiser.zero_grad()


def read_curve(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Step and PSNR (dB) of each record, for both sets."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {name: [(row["step"], row[name]) for row in rows if name in row] for name in SETS}


def last_doubling(curve: list[tuple[int, float]]) -> float:
    """Gain in dB from half of the steps to all of them."""
    half = min(curve, key=lambda point: abs(point[0] - curve[-1][0] / 2))
    return curve[-1][1] - half[1]


def curve() -> None:
    parser = argparse.ArgumentParser(description="Plots an encoder's training.")
    parser.add_argument("--metrics", type=Path, required=True, help="metrics.jsonl of a run")
    parser.add_argument("--plot", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    curves = read_curve(arguments.metrics)
    for name, curve in curves.items():
        steps, psnr = curve[-1]
        print(f"{name}: {psnr:.2f} dB after {steps} steps, {last_doubling(curve):+.2f} in the last doubling")
    if arguments.plot is not None:
        figure = Figure(figsize=(7, 4), layout="constrained")
        axes = figure.subplots()
        for name, curve in curves.items():
            axes.plot(*zip(*curve, strict=True), label=SETS[name])
        axes.set(xlabel="steps", ylabel="PSNR, dB (whole images, 256 x 256)")
        axes.grid(alpha=0.3)
        axes.legend()
        figure.savefig(arguments.plot, dpi=120)


def row(model: EncoderModel, captures: Captures, name: str, novel_frame: int) -> Iterator[np.ndarray]:
    """The person's pictures in the order of COLUMNS, each cropped around the person; sRGB bytes."""
    subject, betas = captures.subject(name), default_betas(captures.subject(name))
    given = spread_cameras(subject, 0, VIEWS)
    novel = [camera for camera in range(len(subject.views)) if camera not in given] or list(given)
    shown = (given[0], novel[0], novel[len(novel) // 2])
    views = conditioning_views(captures, name, 0, given, SIZE)
    payload = encode_and_fit(model, views, betas)
    for number, (frame, camera) in enumerate(zip((0, 0, novel_frame), shown, strict=True)):
        seen = conditioning_views(captures, name, frame, [camera], SIZE)
        primitives = model.place(payload, betas, seen.pose)
        view = seen.camera.map(lambda tensor: tensor[0])
        drawn, target = encode_srgb(march(primitives, view).rgb.clamp(0, 1)), seen.image[0].float() / 255
        for image in (target, drawn) if number == 0 else (drawn, target):
            yield cropped(image, seen.mask[0])
    for look in ("depth", "boxes"):
        yield cropped(drawn_view(primitives, view, look), seen.mask[0])


def drawn_view(primitives: Primitives, camera: Camera, look: str) -> Tensor:
    """The depth or the primitives, drawn over black, sRGB-encoded."""
    drawn = draw(Scene(primitives, chart=default_anchors().chart), camera, ViewSettings(look))
    return encode_srgb(torch.from_numpy(drawn.rgb).clamp(0, 1))


def cropped(image: Tensor, mask: Tensor) -> np.ndarray:
    """The square around the person, as bytes; black outside the picture."""
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    middle = [(int(hits[0]) + int(hits[-1])) / 2 for hits in (rows, columns)]
    longest = max(int(rows[-1] - rows[0]), int(columns[-1] - columns[0])) + 1
    side = round(longest / (1 - 2 * MARGIN))
    top, left = (round(centre - side / 2) for centre in middle)
    padded = torch.nn.functional.pad(image, (0, 0, side, side, side, side))[
        top + side : top + 2 * side, left + side : left + 2 * side
    ]
    return (padded.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def sheet(rows: list[tuple[str, list[np.ndarray]]], cell: int) -> Image.Image:
    """The rows one below the other, with column headings and row names."""
    whole = Image.new("RGB", (NAME + cell * len(COLUMNS), HEADING + cell * len(rows)), PAPER)
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(14)
    for number, title in enumerate(COLUMNS):
        pen.text((NAME + (number + 0.5) * cell, HEADING / 2), title, INK, font, anchor="mm")
    for number, (title, pictures) in enumerate(rows):
        label = Image.new("RGB", (cell, NAME), PAPER)
        ImageDraw.Draw(label).text((cell / 2, NAME / 2), title, INK, font, anchor="mm")
        whole.paste(label.rotate(90, expand=True), (0, HEADING + number * cell))
        for column, pixels in enumerate(pictures):
            small = Image.fromarray(pixels).resize((cell, cell), Image.Resampling.LANCZOS)
            whole.paste(small, (NAME + column * cell, HEADING + number * cell))
    return whole


def pictures() -> None:
    parser = argparse.ArgumentParser(description="Draws the documentation's picture of the encoder.")
    parser.add_argument("--train", type=Path, help="captures of training people")
    parser.add_argument("--heldout", type=Path, help="captures of held-out people")
    parser.add_argument("--checkpoint", type=Path, help="without it, the package's encoder")
    parser.add_argument("--people", type=int, default=3, help="number of people from each set, evenly spaced")
    parser.add_argument("--cell", type=int, default=224, help="side of a picture in pixels")
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    arguments = parser.parse_args()
    model = load_encoder(arguments.checkpoint)
    rows = []
    for title, root in (("trained on", arguments.train), ("held out", arguments.heldout)):
        if root is None:
            continue
        captures = open_captures(root)
        count = min(arguments.people, len(captures.subjects))
        for number in range(count):
            name = captures.subjects[number * len(captures.subjects) // count]
            last = captures.subject(name).frames - 1
            novel_frame = 1 + number % last if last else 0
            rows.append((title, list(row(model, captures, name, novel_frame))))
    if not rows:
        parser.error("give captures with --train or --heldout")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    sheet(rows, arguments.cell).save(arguments.out, optimize=True)
    print(arguments.out)


if __name__ == "__main__":
    run(main, curve=curve, pictures=pictures)
