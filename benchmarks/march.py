"""How fast and how exact the CPU marcher is: one person of 1024 boxes that fills the frame.

`python benchmarks/march.py --json march.json` writes one flat object; `--quick` (under a minute) leaves out the largest
picture and the truth at a quarter of a millimetre. Seconds are medians of warm calls; errors are in 0 ... 255.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import torch
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu import march_cpu
from primdiffusion.render.lattice import UNIFORM_MILLIMETRE, MarchSettings, strides_of
from primdiffusion.render.reference import march_reference
from torch import Tensor

LIMBS = (
    # one end, other end (metres, y up), radius, boxes along, boxes around
    ((0.0, 0.90, 0.0), (0.0, 1.38, 0.0), 0.150, 16, 24),
    ((0.0, 1.55, 0.0), (0.0, 1.68, 0.0), 0.095, 9, 16),
    ((0.20, 1.38, 0.0), (0.78, 1.25, 0.0), 0.045, 15, 8),
    ((-0.20, 1.38, 0.0), (-0.78, 1.25, 0.0), 0.045, 15, 8),
    ((0.10, 0.85, 0.0), (0.13, 0.05, 0.0), 0.070, 16, 8),
    ((-0.10, 0.85, 0.0), (-0.13, 0.05, 0.0), 0.070, 16, 8),
)
FULL_DENSITY = 100.0
"""1/m below the surface."""


def standing_person(seed: int = 0) -> Primitives:
    """1024 boxes on six capsules, opaque below the capsules' surfaces, coloured by random smooth patterns."""
    generator = torch.Generator().manual_seed(seed)
    parts = [_limb(*limb) for limb in LIMBS]
    position, rotation, half_extent = (torch.cat(field) for field in zip(*parts, strict=True))
    k = len(position)
    depth = torch.linspace(-1, 1, 8)[:, None, None] * half_extent[:, 2, None, None, None]
    density = FULL_DENSITY * (0.5 - depth / 0.004).clamp(0, 1).expand(k, 8, 8, 8)
    coarse = torch.rand((k, 3, 3, 3, 3), generator=generator)
    rgb = torch.nn.functional.interpolate(coarse, size=(8, 8, 8), mode="trilinear", align_corners=True)
    return Primitives(position, rotation, half_extent, rgb, density.contiguous())


def _limb(
    start: tuple[float, ...], end: tuple[float, ...], radius: float, along: int, around: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, rotations [T, B, N] and half extents of boxes on a capsule; neighbours overlap by a third."""
    a, b = torch.tensor(start), torch.tensor(end)
    axis = torch.nn.functional.normalize(b - a, dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    front = torch.linalg.cross(axis, side)
    length = float((b - a).norm()) + 2 * radius
    place = (torch.arange(along) + 0.5) / along * length - radius
    over_cap = place - place.clamp(0, length - 2 * radius)
    girth = (radius**2 - over_cap**2).clamp_min(0).sqrt()
    angle = (torch.arange(around) + 0.5) / around * 2 * math.pi
    outward = angle.cos()[:, None] * side + angle.sin()[:, None] * front
    normal = (outward * girth[:, None, None] + axis * over_cap[:, None, None]) / radius
    tangent = (-angle.sin()[:, None] * side + angle.cos()[:, None] * front).expand_as(normal)
    position = a + place[:, None, None] * axis + girth[:, None, None] * outward
    rotation = torch.stack([tangent, torch.linalg.cross(normal, tangent, dim=-1), normal], dim=-1)
    width = (2 / 3) * 2 * math.pi * girth.clamp_min(radius / 3) / around
    half_extent = torch.stack(
        [width, torch.full_like(width, (2 / 3) * length / along), torch.full_like(width, 0.03)], -1
    )
    return position.flatten(0, 1), rotation.flatten(0, 1), half_extent.repeat_interleave(around, dim=0)


def portrait(size: int) -> Camera:
    """The whole person in a square picture."""
    position, target = torch.tensor([0.6, 1.1, 3.2]), torch.tensor([0.0, 0.87, 0.0])
    return look_at(position, target, vertical_fov=math.radians(32), width=size, height=size)


def seconds(call: Callable[[], object], repeats: int) -> float:
    """The median of `repeats` timed calls."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def errors(a: Tensor, b: Tensor) -> tuple[float, float]:
    """Largest and mean difference, 0 ... 255."""
    difference = (a.double() - b.double()).abs() * 255
    return float(difference.max()), float(difference.mean())


def measure(quick: bool) -> dict[str, float | int | str | None]:
    """All figures of this benchmark by name."""
    person = standing_person()
    figures: dict[str, float | int | str | None] = {"boxes": len(person.position)}
    stride = strides_of(person, MarchSettings())
    figures |= {f"boxes_of_stride_{s}": int((stride == s).sum()) for s in MarchSettings().strides}
    figures["first_call_s"] = seconds(lambda: march_cpu(person, portrait(64)), 1)
    for size in (256, 512) if quick else (256, 512, 1024):
        camera = portrait(size)
        figures[f"cpu_{size}_s"] = seconds(lambda camera=camera: march_cpu(person, camera), 3 if quick else 7)
    camera = portrait(512)
    figures["cpu_512_every_mm_s"] = seconds(lambda: march_cpu(person, camera, UNIFORM_MILLIMETRE), 3)

    small = portrait(128)
    figures["reference_128_s"] = seconds(lambda: march_reference(person, small), 1)
    figures["cpu_128_s"] = seconds(lambda: march_cpu(person, small), 7)
    figures["reference_over_cpu_128"] = figures["reference_128_s"] / figures["cpu_128_s"]
    exact = march_reference(person.to(dtype=torch.float64), small.to(dtype=torch.float64))
    picture = march_cpu(person, small)
    figures["hit_share"] = float((picture.alpha > 0).float().mean())
    figures["cpu_against_float64_reference_max"], figures["cpu_against_float64_reference_mean"] = errors(
        picture.rgb, exact.rgb
    )
    truth_names = [f"{name}_{kind}" for name in ("default", "every_mm") for kind in ("max", "mean")]
    figures |= dict.fromkeys(truth_names)
    if not quick:
        truth = march_cpu(person, small, MarchSettings(step=0.00025, strides=(1,)))
        figures["default_max"], figures["default_mean"] = errors(picture.rgb, truth.rgb)
        every_mm = march_cpu(person, small, UNIFORM_MILLIMETRE)
        figures["every_mm_max"], figures["every_mm_mean"] = errors(every_mm.rgb, truth.rgb)
    return figures


def circumstances() -> dict[str, str | int]:
    """What a reader needs to compare the figures with others."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return {
        "device": f"{platform.processor() or platform.machine()} CPU",
        "threads": numba.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "commit": commit.stdout.strip() or "unknown",
    }


def main() -> None:
    """Measures, prints and, if asked, writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--quick", action="store_true", help="under a minute")
    arguments = parser.parse_args()
    text = json.dumps(circumstances() | measure(arguments.quick), indent=2)
    if arguments.json:
        arguments.json.write_text(text + "\n")
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
