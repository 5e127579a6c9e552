"""The ablations of the paper's Table 3 in the paper's own form: texel look-up, no skips, a constant base.

`python benchmarks/encoder_paper_form.py --train CAPTURES --novel CAPTURES --out DIR --minutes 7 --json
docs/results/encoder_paper_form.json` trains the preset paper and its ablations for equal time of the processor on small
pictures, and compares them with captures in poses and views that training had not: --novel is of the same people from
other sides, and its first poses, --given of them, are those of --train. The first pose is encoded, from eight sides.
Encoders that are there are not trained again.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from primdiffusion.capture.reader import Captures, open_captures
from primdiffusion.encoder.config import Ablation
from primdiffusion.encoder.model import load_encoder, save_encoder
from primdiffusion.evaluation.reconstruction import EvaluationSettings, Means, evaluate, summary
from primdiffusion.training.fit import EncoderTask
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.loop import begin_training, take_step
from primdiffusion.training.state import TrainingState, accelerator_of
from record import command_line, report

FORMS: dict[str, Ablation | None] = {
    "full": None,
    "shared_scale": "shared_scale",
    "template_rt": "template_rt",
    "no_attention": "no_attention",
}
PAPER_PSNR = {"full": 32.15, "shared_scale": 18.35, "template_rt": 31.70, "no_attention": 28.39}
TRIED = 7
"""Steps that are timed to plan the others; the first two are warm-up."""
Figures = dict[str, float | int | str | None]


def main() -> None:
    arguments = parsed()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    captures, novel = open_captures(arguments.train), open_captures(arguments.novel)
    figures: Figures = {}
    for name, ablation in FORMS.items():
        path = arguments.out / f"{name}.safetensors"
        if not path.is_file():
            train(arguments, ablation, captures, path)
        figures |= figures_of(name, path, measured(path, novel, arguments))
        print(name, {key: value for key, value in figures.items() if key.endswith(f"_{name}")}, flush=True)
    report(figures, arguments.json)


def parsed() -> argparse.Namespace:
    parser = command_line(__doc__)
    parser.add_argument("--train", type=Path, required=True, help="captures to train on")
    parser.add_argument("--novel", type=Path, required=True, help="captures of the same people, with further poses")
    parser.add_argument("--given", type=int, default=4, help="poses of --novel that training had")
    parser.add_argument("--out", type=Path, required=True, help="folder for the encoders")
    parser.add_argument("--minutes", type=float, default=7.0, help="of the processor, for each form")
    parser.add_argument("--size", type=int, default=128, help="pixels a side of the pictures in training")
    parser.add_argument("--compared-size", type=int, default=256, help="pixels a side of those that are compared")
    parser.add_argument("--cameras", type=int, default=4, help="views of a pose that are compared")
    return parser.parse_args()


def settings(arguments: argparse.Namespace, ablation: Ablation | None, count: int) -> FitConfig:
    """Few small pictures a step, and rates for few steps."""
    return FitConfig(
        data=arguments.train,
        run=arguments.out / (ablation or "full"),
        encoder="paper",
        ablation=ablation,
        steps=count,
        batch=2,
        views=6,
        targets=2,
        size=arguments.size,
        step=0.008,
        learning_rate=2e-4,
        place_rate=20.0,
        hold_scale=count // 10,
        ema=0.98,
    )


def train(arguments: argparse.Namespace, ablation: Ablation | None, captures: Captures, path: Path) -> None:
    """Trains for the processor's time and writes the encoder. A few steps that are thrown away plan the others."""
    tried = list(timed_steps(settings(arguments, ablation, TRIED), captures))
    seconds = 60 * arguments.minutes
    planned = max(TRIED, round(seconds / statistics.median([one.seconds for one in tried[2:]])))
    taken, total = tried[-1], 0.0
    for taken in timed_steps(settings(arguments, ablation, planned), captures):
        total += taken.seconds
        if taken.state.step % 50 == 0:
            done = f"{taken.state.step} of {planned} {total:.0f} s, loss {taken.loss:.4f}"
            print(ablation or "full", done, flush=True)
        if total > seconds:
            break
    taken.state.seconds = total
    save_encoder(path, taken.task.model(taken.state))


class Taken(NamedTuple):
    """A step of training."""

    task: EncoderTask
    state: TrainingState
    seconds: float
    loss: float


def timed_steps(config: FitConfig, captures: Captures) -> Iterator[Taken]:
    """The steps of `primdiffusion fit`, and the processor's seconds of each."""
    task = EncoderTask(config, captures, accelerator_of())
    state = begin_training(task, task.accelerator)
    began = time.process_time()
    while state.step < config.steps:
        progress = take_step(task, config.seed, state)
        yield Taken(task, state, time.process_time() - began, sum(progress.terms.values()))
        began = time.process_time()


def measured(path: Path, novel: Captures, arguments: argparse.Namespace) -> Means:
    """Means over poses and views that training had not."""
    subject = novel.subject(novel.subjects[0])
    every, count = len(subject.views), arguments.cameras
    evaluated = EvaluationSettings(
        frames=tuple(range(arguments.given, subject.frames)),
        cameras=tuple(number * every // count for number in range(count)),
        size=arguments.compared_size,
    )
    return summary(evaluate(load_encoder(path), novel, evaluated))["all"]


def figures_of(name: str, path: Path, means: Means) -> Figures:
    """Figures of one form, beside the paper's PSNR (training people, all views and poses)."""
    card = load_encoder(path).card
    return {
        f"psnr_{name}": means["psnr"] and round(means["psnr"], 3),
        f"ssim_{name}": means["ssim"] and round(means["ssim"], 5),
        f"psnr_box_{name}": means["psnr_box"] and round(means["psnr_box"], 3),
        f"mask_iou_{name}": means["mask_iou"] and round(means["mask_iou"], 4),
        f"paper_psnr_{name}": PAPER_PSNR[name],
        f"steps_{name}": card["steps"],
        f"minutes_{name}": round(card["seconds"] / 60, 2),
        f"pictures_{name}": means["pictures"],
    }


if __name__ == "__main__":
    main()
