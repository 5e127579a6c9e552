"""Speed and exactness of the marcher, for different people, poses, picture sizes, numbers of boxes and crowds.

`python benchmarks/march.py --json march.json --table march.md --plot march.png` measures everything; `--quick` (about a
minute) leaves out the largest pictures and the engine in Blender. Milliseconds are PROCESSOR time of all threads
together, the best of several warm calls, because wall time is unreliable on a shared machine. The roofline
is measured in the same run. Errors are against `march_reference` in float64, with pixel values in 0 ... 1.

A sample costs about 136 floating-point operations (SPEC 4): 24 for its position, 50 for trilinear weights and indices,
56 for four channels at eight corners, the rest for the window and the sums. The ceiling is what the same compiler
reaches on a polynomial of degree 32 whose arguments are in the first-level cache: two operations per step, no waiting
for memory.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numba
import numpy as np
import torch
from march_people import Scene, checkered_human, contorted, in_fewer_boxes, scenes, standing_person
from marching import OPERATIONS_PER_SAMPLE, leaves, portrait
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.human import framing, place
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.march import count_samples
from primdiffusion.render.lattice import UNIFORM_MILLIMETRE, MarchSettings, strides_of
from primdiffusion.render.march import march
from primdiffusion.render.reference import march_reference
from record import command_line, report
from torch import Tensor

DEGREE = 32
ARGUMENTS = 2048
"""8 KB: they stay in the first-level cache."""
ROUNDS = 2000
HERE = Path(__file__).resolve().parent
Figures = dict[str, float | int | str | None]
ENGINE_FIGURES = ("engine_overhead_ms", "engine_pixel_error_max")
CUDA_FIGURES = ("cuda_forward_4mm_ms", "cuda_forward_1mm_ms", "cuda_backward_ratio")

COLOURS = {"size": "#1b6ca8", "person": "#c8553d", "pose": "#6a994e", "boxes": "#7b2d8b", "people": "#222222"}


@numba.njit(fastmath=True)
def _polynomial(argument, value, rounds):
    factor, term = np.float32(0.999), np.float32(0.001)
    for _ in range(rounds):
        for i in range(len(argument)):
            x, v = argument[i], value[i]
            for _ in range(DEGREE // 4):
                v = v * x + term
                v = v * x + factor
                v = v * x + term
                v = v * x + factor
            value[i] = v


def float32_operations_per_second(repeats: int = 7) -> float:
    """Operations per second of ONE thread, the best of `repeats` runs; a fused multiply-add counts as two."""
    argument = np.linspace(0.1, 0.9, ARGUMENTS, dtype=np.float32)
    value = np.zeros(ARGUMENTS, np.float32)
    _polynomial(argument, value, 1)
    best = np.inf
    for _ in range(repeats):
        began = time.process_time()
        _polynomial(argument, value, ROUNDS)
        best = min(best, time.process_time() - began)
    return 2 * DEGREE * ARGUMENTS * ROUNDS / best


def roofline_ms(samples: int, operations_per_second: float) -> float:
    """Milliseconds for `samples` on one thread at the ceiling."""
    return 1e3 * samples * OPERATIONS_PER_SAMPLE / operations_per_second


@dataclasses.dataclass(frozen=True)
class Row:
    """The cost of one picture; milliseconds are processor time of all threads together."""

    group: str
    name: str
    pixels: int
    boxes: int
    hit_share: float
    samples: int
    """Lattice points inside boxes on rays that are not yet opaque: the work of SPEC 4."""
    evaluated: int
    """The samples that were looked up; the others are where a box is empty."""
    milliseconds: float
    roofline_ms: float
    """The time of `samples` at the processor's measured ceiling."""


def best_ms(call: Callable[[], object], repeats: int, clock: Callable[[], float] = time.process_time) -> float:
    """Milliseconds of the fastest of `repeats` calls."""
    fastest = float("inf")
    for _ in range(repeats):
        began = clock()
        call()
        fastest = min(fastest, clock() - began)
    return 1e3 * fastest


def backward_ms(person: Primitives, camera: Camera, repeats: int) -> tuple[float, float]:
    """Milliseconds of a forward call that saves what the adjoint needs, and of the adjoint for every input."""
    forward, backward = float("inf"), float("inf")
    for _ in range(repeats):
        boxes, view = leaves(person), leaves(camera)
        began = time.process_time()
        picture = march(boxes, view)
        between = time.process_time()
        seen = torch.where(picture.alpha > 0, picture.depth, 0)
        loss = picture.rgb.square().sum() + picture.alpha.sum() + seen.sum()
        middle = time.process_time()
        loss.backward()
        forward, backward = min(forward, between - began), min(backward, time.process_time() - middle)
    return 1e3 * forward, 1e3 * backward


def measured_row(scene: Scene, operations_per_second: float, repeats: int) -> Row:
    """The cost of one picture."""
    settings = MarchSettings()
    counted = count_samples(scene.primitives, scene.camera, settings)
    forward = best_ms(lambda: march(scene.primitives, scene.camera, settings), repeats)
    alpha = march(scene.primitives, scene.camera, settings).alpha
    return Row(
        group=scene.group,
        name=scene.name,
        pixels=scene.camera.width * scene.camera.height,
        boxes=len(scene.primitives.position),
        hit_share=float((alpha > 0).float().mean()),
        samples=counted.inside_boxes,
        evaluated=counted.evaluated,
        milliseconds=forward,
        roofline_ms=roofline_ms(counted.inside_boxes, operations_per_second),
    )


def speed(person: Primitives, operations_per_second: float, repeats: int) -> Figures:
    """Figures of the default picture: forward at 4 and 1 mm, the adjoint, the reference."""
    camera = portrait(512)
    figures: Figures = {"boxes": len(person.position)}
    stride = strides_of(person, MarchSettings())
    figures |= {f"boxes_of_stride_{s}": int((stride == s).sum()) for s in MarchSettings().strides}
    for name, settings in (("4mm", MarchSettings()), ("1mm", UNIFORM_MILLIMETRE)):
        counted = count_samples(person, camera, settings)
        milliseconds = best_ms(lambda settings=settings: march(person, camera, settings), repeats)
        floor = roofline_ms(counted.inside_boxes, operations_per_second)
        figures |= {
            f"cpu_forward_{name}_ms": milliseconds,
            f"cpu_samples_{name}": counted.inside_boxes,
            f"cpu_samples_evaluated_{name}": counted.evaluated,
            f"cpu_roofline_{name}_ms": floor,
            f"cpu_roofline_ratio_{name}": milliseconds / floor,
        }
    people = crowd()
    far = look_at(torch.tensor([0.0, 0.0, 8.0]), torch.zeros(3), vertical_fov=0.5, width=256, height=256)
    figures["cpu_forward_crowd_ms"] = best_ms(lambda: march(people, far), repeats)
    figures["cpu_forward_4mm_wall_ms"] = best_ms(lambda: march(person, camera), repeats, time.perf_counter)
    forward, backward = backward_ms(person, camera, max(repeats // 2, 2))
    figures |= {
        "cpu_forward_recorded_4mm_ms": forward,
        "cpu_backward_4mm_ms": backward,
        "cpu_backward_ratio": backward / float(figures["cpu_forward_4mm_ms"] or 0),
    }
    small = portrait(128)
    slow = best_ms(lambda: march_reference(person, small), 2)
    figures["reference_over_cpu_128"] = slow / best_ms(lambda: march(person, small), repeats)
    return figures


def crowd() -> Primitives:
    """Sixteen people of 4096 small boxes: 4.3e9 pairs of a box and a pixel, almost none of which intersect."""
    count = 16 * 4096
    return Primitives(
        position=torch.rand((count, 3), generator=torch.Generator().manual_seed(27)) * 4 - 2,
        rotation=torch.eye(3).expand(count, 3, 3),
        half_extent=torch.full((count, 3), 0.004),
        rgb=torch.full((count, 3, 2, 2, 2), 0.5),
        density=torch.full((count, 2, 2, 2), 10.0),
    )


def largest_error(person: Primitives, camera: Camera) -> float:
    """Largest difference in rgb from the reference in float64, with values in 0 ... 1."""
    exact = march_reference(person.to(dtype=torch.float64), camera.to(dtype=torch.float64))
    return float((march(person, camera).rgb.double() - exact.rgb).abs().max())


def least_cosine(person: Primitives, camera: Camera) -> float:
    """Smallest cosine, over all inputs, between the fast adjoint and torch's through the reference in float64."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn((camera.height, camera.width, 5), generator=generator, dtype=torch.float64)

    def gradients(boxes: Primitives, view: Camera, draw: Callable[..., object]) -> dict[str, Tensor]:
        boxes, view = leaves(boxes), leaves(view)
        picture = draw(boxes, view)
        depth = torch.where(picture.alpha > 0.05, picture.depth, 0)
        values = torch.cat([picture.rgb, picture.alpha[..., None], depth[..., None]], dim=-1)
        (values * weight.to(values.dtype)).sum().backward()
        tensors = {**vars(boxes), "intrinsics": view.intrinsics, "world_to_camera": view.world_to_camera}
        return {name: tensor.grad.double().flatten() for name, tensor in tensors.items()}

    fast = gradients(person, camera, march)
    exact = gradients(person.to(dtype=torch.float64), camera.to(dtype=torch.float64), march_reference)
    cosines = {name: float(torch.cosine_similarity(fast[name], exact[name], dim=0)) for name in fast}
    return min(cosines.values())


def inside_the_chest(size: int) -> Camera:
    """A camera inside the boxes of the chest, looking at an arm."""
    return look_at(
        torch.tensor([0.05, 0.2, 0.05]), torch.tensor([0.6, 0.3, 0.0]), vertical_fov=1.2, width=size, height=size
    )


def exactness(person: Primitives) -> Figures:
    """Errors against the reference in float64: from the front, contorted, fewer boxes, fully opaque, from inside."""
    posed = place(checkered_human(), contorted())
    opaque = dataclasses.replace(person, density=person.density * 10)
    pictures = [
        (person, portrait(128)),
        (posed, framing(posed, width=96, height=96)),
        (in_fewer_boxes(person), portrait(96)),
        (opaque, portrait(96)),
        (person, inside_the_chest(64)),
    ]
    return {
        "rgb_error_max": max(largest_error(*picture) for picture in pictures),
        "gradient_cosine_min": min(least_cosine(boxes, shrunk(view)) for boxes, view in pictures),
    }


def shrunk(camera: Camera, size: int = 48) -> Camera:
    """The same view with fewer pixels: the recorded gradients of the reference need memory for every sample."""
    scale = camera.intrinsics.new_tensor([size / camera.width, size / camera.height, 1.0])
    return dataclasses.replace(camera, intrinsics=camera.intrinsics * scale[:, None], width=size, height=size)


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write a markdown table with one row per picture."""
    lines = [
        "| varied | picture | boxes | hit rays | samples (M) | evaluated (M) | ms | ns per sample | x roofline |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.group} | {row.name} | {row.boxes} | {row.hit_share:.1%} | {row.samples / 1e6:.2f} | "
            f"{row.evaluated / 1e6:.2f} | {row.milliseconds:.1f} | {1e6 * row.milliseconds / row.samples:.1f} | "
            f"{row.milliseconds / row.roofline_ms:.1f} |"
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_plot(path: Path, rows: Sequence[Row]) -> None:
    """Plot time against samples, where all pictures lie on one line, and against boxes x pixels, where they do not."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.4), sharey=True)
    for group, colour in COLOURS.items():
        members = [row for row in rows if row.group == group]
        times = [row.milliseconds for row in members]
        left.loglog([row.samples for row in members], times, "o", color=colour, label=group)
        right.loglog([row.boxes * row.pixels for row in members], times, "o", color=colour)
    ordered = sorted(rows, key=lambda row: row.samples)
    samples = [row.samples for row in ordered]
    left.loglog(samples, [row.roofline_ms for row in ordered], "k-", linewidth=1, label="roofline")
    left.loglog(samples, [8 * row.roofline_ms for row in ordered], "k--", linewidth=1, label="8 x roofline")
    left.set(xlabel="samples inside boxes", ylabel="processor time per picture, ms")
    right.set(xlabel="boxes x pixels")
    left.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(True, which="both", linewidth=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def from_script(script: str, names: tuple[str, ...], *arguments: str) -> Figures:
    """The figures `names` of another benchmark's record; None if the script cannot measure them here."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "record.json"
        ran = subprocess.run([sys.executable, str(HERE / script), "--json", str(record), *arguments], check=False)
        if ran.returncode or not record.is_file():
            return dict.fromkeys(names)
        figures = json.loads(record.read_text(encoding="utf-8"))
        return {name: figures.get(name) for name in names}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--table", type=Path, help="markdown file for the table of scenes")
    parser.add_argument("--plot", type=Path, help="PNG of time against samples")
    parser.add_argument("--quick", action="store_true", help="about a minute")
    arguments = parser.parse_args()
    repeats = 5 if arguments.quick else 15

    person = standing_person()
    figures: Figures = {"threads": numba.get_num_threads()}
    figures["first_call_s"] = best_ms(lambda: march(person, portrait(64)), 1, time.perf_counter) / 1e3
    ceiling = float32_operations_per_second()
    figures["cpu_gflops_per_thread"] = ceiling / 1e9
    figures |= speed(person, ceiling, repeats)
    figures |= exactness(person)
    rows = [measured_row(scene, ceiling, repeats) for scene in scenes(1024 if arguments.quick else 2048)]
    figures |= dict.fromkeys(CUDA_FIGURES)
    if torch.cuda.is_available():
        figures |= from_script("march_cuda.py", CUDA_FIGURES)
    figures |= dict.fromkeys(ENGINE_FIGURES) if arguments.quick else from_script("engine.py", ENGINE_FIGURES)
    report(figures, arguments.json)
    if arguments.table is not None:
        write_table(arguments.table, rows)
    if arguments.plot is not None:
        write_plot(arguments.plot, rows)


if __name__ == "__main__":
    main()
