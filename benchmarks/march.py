"""How fast and how exact the CPU marcher is: one person of 1024 boxes that fills the frame.

`python benchmarks/march.py --json march.json` writes one flat object; `--quick` (under a minute) leaves out the largest
picture and the truth at a quarter of a millimetre. Seconds are medians of warm calls; errors are in 0 ... 255.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch
from primdiffusion.body.model import default_body
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import from_mesh
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu import march_cpu
from primdiffusion.render.lattice import UNIFORM_MILLIMETRE, MarchSettings, strides_of
from primdiffusion.render.reference import march_reference
from record import tell
from torch import Tensor


def standing_person(seed: int = 0) -> Primitives:
    """The default body's 1024 boxes in the rest pose, filled from its mesh under a random checkered texture."""
    body = default_body()
    vertices = body.shape(torch.zeros(10)).vertices
    frames = attach(default_anchors(), vertices, body.faces)
    cells = np.random.default_rng(seed).integers(40, 230, (32, 32, 4), dtype=np.uint8)
    texture = cells.repeat(8, axis=0).repeat(8, axis=1)
    texture[..., 3] = 255
    skin = TexturedPart(
        name="body",
        vertices=vertices.double().numpy(),
        faces=body.faces.int().numpy(),
        corner_uv=body.uv[body.uv_faces].double().numpy(),
        texture=texture,
        skin_index=np.zeros((len(vertices), 1), np.int32),
        skin_weight=np.ones((len(vertices), 1)),
    )
    return Primitives.place(frames, from_mesh(TexturedMesh((skin,)), frames))


def portrait(size: int) -> Camera:
    """The whole person in a square picture; the body's origin is near its pelvis."""
    position, target = torch.tensor([0.6, 0.1, 3.2]), torch.tensor([0.0, -0.3, 0.0])
    return look_at(position, target, vertical_fov=math.radians(32), width=size, height=size)


def seconds(call: Callable[[], object], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """The median of `repeats` timed calls."""
    times = []
    for _ in range(repeats):
        begin = clock()
        call()
        times.append(clock() - begin)
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
    # What all threads together computed: on a busy machine the honest figure.
    figures["cpu_512_processor_s"] = seconds(lambda: march_cpu(person, camera), 3, time.process_time)
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


def main() -> None:
    """Measures, prints and, if asked, writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--quick", action="store_true", help="under a minute")
    arguments = parser.parse_args()
    figures = {"threads": numba.get_num_threads()} | measure(arguments.quick)
    tell(figures, arguments.json)


if __name__ == "__main__":
    main()
