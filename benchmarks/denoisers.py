"""Size and speed of the denoisers, and the error of the default checkpoint on held-out people.

`python benchmarks/denoisers.py --json denoisers.json` writes one flat object; `--quick` (under a minute) skips the
call of the paper's network. Seconds are medians of warm calls on the CPU. Held-out errors are read from the
checkpoint's card: they were measured in training, on people that are not in the repository.
"""

from __future__ import annotations

import time

import torch
from primdiffusion.diffusion.checkpoint import default_checkpoint, load_checkpoint
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import DiffusionModel, sample
from primdiffusion.diffusion.unet import PAPER, PAPER_WITH_ATTENTION, SlabUNet
from record import command_line, report
from torch.utils.flop_counter import FlopCounterMode

STEPS = 30
PEOPLE = 8


def median_seconds(model: DiffusionModel, repeats: int) -> float:
    """Seconds to sample one person in STEPS DDIM steps."""
    times = []
    for seed in range(repeats + 1):
        begin = time.perf_counter()
        for _ in sample(model, [seed], STEPS):
            pass
        times.append(time.perf_counter() - begin)
    return sorted(times[1:])[repeats // 2]


def spread(model: DiffusionModel, count: int) -> float:
    """RMS distance of generated people from their mean, divided by that of the prior fitted to the data."""
    people = torch.cat([list(sample(model, [seed], STEPS))[-1].x0 for seed in range(count)]).flatten(1)
    generated = people.var(0).sum().sqrt()
    if not isinstance(model.denoiser, PersonDenoiser):
        raise TypeError("variety is measured against a prior, which only the default architecture has")
    expected = model.denoiser.prior.marginal_variance().sum() + model.denoiser.prior.rest_variance.sum()
    return float(generated / expected.sqrt())


def gigaflops(network: torch.nn.Module, shape: tuple[int, ...]) -> float:
    """10^9 multiplications and additions in one call for one person, counted without computing it."""
    with FlopCounterMode(display=False) as counter, torch.device("meta"), torch.inference_mode():
        network(torch.empty(1, *shape), torch.zeros(1, dtype=torch.int64))
    return counter.get_total_flops() / 1e9


def paper_network() -> dict[str, float | int | None]:
    """Numbers of weights of the paper's network, with and without attention at two levels."""
    figures: dict[str, float | int | None] = {}
    for name, config in (("paper", PAPER), ("paper_attention", PAPER_WITH_ATTENTION)):
        with torch.device("meta"):
            network = SlabUNet(config)
        figures[f"denoiser_{name}_parameters"] = sum(p.numel() for p in network.parameters())
        figures[f"denoiser_{name}_gflop"] = round(gigaflops(network, (56, 256, 256)), 1)
    return figures


def paper_call_seconds() -> float:
    """Seconds of one call of the paper's network for one person, with untrained weights."""
    network = SlabUNet().eval()
    x, t = torch.randn(1, 56, 256, 256), torch.zeros(1, dtype=torch.int64)
    begin = time.perf_counter()
    with torch.inference_mode():
        network(x, t)
    return time.perf_counter() - begin


def measure(quick: bool) -> dict[str, float | int | None]:
    """All figures; None means not measured here."""
    model = load_checkpoint()
    figures: dict[str, float | int | None] = {
        "checkpoint_megabytes": round(default_checkpoint().stat().st_size / 1e6, 2),
        "denoiser_default_parameters": sum(p.numel() for p in model.denoiser.parameters()),
        "generate_30_steps_seconds": round(median_seconds(model, 3 if quick else 9), 3),
        "generate_spread_over_data": round(spread(model, PEOPLE if quick else 8 * PEOPLE), 3),
        **paper_network(),
        "denoiser_paper_call_seconds": None if quick else round(paper_call_seconds(), 2),
    }
    for name, by_level in model.card["held_out_rms_x0_error"].items():
        figures |= {f"held_out_error_{name}_{level}": error for level, error in by_level.items()}
    return figures


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true", help="under a minute")
    arguments = parser.parse_args()
    figures = measure(arguments.quick)
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
