"""Speed and exactness of the marcher on a CUDA device, for one person of 1024 boxes that fills the frame.

`python benchmarks/march_cuda.py --json march_cuda.json` prints and writes one flat object. Milliseconds are medians
between CUDA events around whole calls, including launches and the wait for checks: cuda_forward of a prepared scene
(`Marcher`), cuda_march of `march_cuda` called again and again, cuda_eager of `march_cuda` without graphs, cuda_training
of a forward and a backward pass in one graph. cuda_pipelined is the time of a picture out of many in a row, and
cuda_launch_share the part of cuda_forward in which no kernel runs. The ceilings are measured on the same device in the
same run; a sample costs `OPERATIONS_PER_SAMPLE` (SPEC 4) and, without reuse, 128 bytes of voxels.

`--train` also times training steps (`train_cuda.py`), `--cases` runs the tests of the marcher on the device,
`--kernels` prints the time of each kernel, `--sweep` that of different program shapes. A part that fails prints its
traceback, and the others go on; figures are written after each. All but the sweep should take less than eight minutes.

It needs a CUDA device, torch for CUDA, the triton that this torch requires, and the package's own requirements; nothing
is downloaded. From a checkout: `PYTHONPATH=backend python benchmarks/march_cuda.py`. `--write-person FILE` on any
machine, and `--person FILE` on the one with the device, spare the latter the packages that make people.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import os
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from marching import OPERATIONS_PER_SAMPLE, leaves, portrait
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.march import count_samples
from primdiffusion.render.cuda import available
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.render.cuda.march import march_cuda
from primdiffusion.render.cuda.marcher import Marcher
from primdiffusion.render.cuda.scene import Shapes
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import RELEASED, UNIFORM_MILLIMETRE, MarchSettings
from primdiffusion.render.reference import march_reference
from record import command_line, report
from torch import Tensor

if not available("cuda"):
    sys.exit("no triton: install the version that `pip show torch` names")
import triton
import triton.language as tl

ROOT = Path(__file__).resolve().parents[1]
DEVICE = "cuda"
FINE, DEFAULT = UNIFORM_MILLIMETRE, MarchSettings()
SIZES = (256, 512, 1024, 2048)
BATCHES = (4, 16)
BYTES_OF_SAMPLE = 8 * 16
EXACT_SIZE, GRADIENT_SIZE = 128, 96
"""Side in pixels of the pictures that are compared to the reference in float64."""
Figures = dict[str, float | int | bool | str | None]
ROUNDS = 512
CHAINS = 8
"""Independent sums per lane, so that no sum waits for another."""
LANES = 1024
RESIDENT_BYTES = 16 << 20
"""Fits three times into the second-level cache of an H200 (about 50 MB)."""
COPIED_BYTES = 4 << 30


made: dict[str, Any] = {}
"""What `write_person` wrote, if --person was given."""


def person(seed: int) -> Primitives:
    """A standing person. From a file there is one, whose colours are dealt anew to the boxes for each seed."""
    if made:
        first = Primitives(**made["person"])
        return dataclasses.replace(first, rgb=first.rgb.roll(97 * seed, 0))
    # packages that make people
    from march_people import standing_person

    return standing_person(seed)


def samples_of(settings: MarchSettings) -> int:
    """Samples in boxes of a picture of 512 x 512."""
    return made["samples"][settings.step] if made else count_samples(person(0), portrait(512), settings).inside_boxes


def write_person(path: Path) -> None:
    samples = {settings.step: samples_of(settings) for settings in (DEFAULT, FINE)}
    torch.save({"person": dict(vars(person(0))), "samples": samples}, path)


def scene(size: int, views: int = 1, people: int = 1) -> tuple[Primitives, Camera]:
    """A person, or several different ones, and equal views, on the device."""
    boxes = [person(seed) for seed in range(people)]
    names = [field.name for field in dataclasses.fields(Primitives)]
    batch = Primitives(**{name: torch.stack([getattr(person, name) for person in boxes]) for name in names})
    camera = portrait(size).map(lambda tensor: tensor.expand(views, *tensor.shape).clone())
    return batch.to(DEVICE, torch.float32), camera.to(DEVICE, torch.float32)


def forward_ms(boxes: Primitives, camera: Camera, settings: MarchSettings, shapes: Shapes = Shapes()) -> float:  # noqa: B008
    marcher = Marcher(boxes, settings, shapes)
    return median_ms(lambda: marcher(camera))


def march_ms(boxes: Primitives, camera: Camera, settings: MarchSettings) -> float:
    with torch.no_grad():
        return median_ms(lambda: march_cuda(boxes, camera, settings))


def pipelined_ms(boxes: Primitives, camera: Camera, settings: MarchSettings, pictures: int = 50) -> float:
    """Milliseconds of each of many pictures in a row."""
    marcher = Marcher(boxes, settings)

    def draw() -> None:
        for _ in range(pictures):
            marcher(camera)

    return median_ms(draw, 5, 1) / pictures


def kernels_ms(call: Callable[[], object], repeats: int = 20) -> tuple[float, str]:
    """Milliseconds of all kernels of a call, and a table of them."""
    from torch.profiler import ProfilerActivity, profile

    for _ in range(3):
        call()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        for _ in range(repeats):
            call()
        torch.cuda.synchronize()
    events = profiled.key_averages()
    total = sum(event.self_device_time_total for event in events) / repeats / 1e3
    return total, events.table(sort_by="self_cuda_time_total", row_limit=25, max_name_column_width=60)


def step_of(settings: MarchSettings, camera: Camera) -> Callable[..., tuple[Tensor, ...]]:
    """A loss of every output, and the gradients of the boxes."""

    def step(*fields: Tensor) -> tuple[Tensor, ...]:
        own = [field.detach().requires_grad_() for field in fields]
        picture = march_cuda(Primitives(*own), camera, settings)
        depth = torch.where(torch.isfinite(picture.depth), picture.depth, 0)
        loss = picture.rgb.square().mean() + picture.alpha.square().mean() + depth.square().mean()
        return loss.detach(), *torch.autograd.grad(loss, own)

    return step


def graphs() -> Figures:
    """Whether graphs draw the same bits as launches from Python, and the time of a training step as one graph."""
    figures: Figures = {}
    boxes, camera = scene(512)
    fields = tuple(vars(boxes).values())
    for name, settings in (
        ("", DEFAULT),
        ("_1mm", FINE),
        ("_released", dataclasses.replace(RELEASED, pixel_centre=0.5)),
    ):
        step = step_of(settings, camera)
        recorded = cuda_graph.Recorded(step)
        marcher = Marcher(boxes, settings)
        alone = step(*fields)
        same = [all(map(torch.equal, alone, recorded(*fields))) for _ in range(4)]
        eager = march_cuda(leaves(boxes), camera, settings)
        for _ in range(4):
            drawn = (marcher(camera), march_cuda(boxes, camera, settings))
            same += [torch.equal(one.rgb, eager.rgb) and torch.equal(one.depth, eager.depth) for one in drawn]
        figures[f"cuda_graph_same_bits{name}"] = all(same)
        print(f"same bits{name}: {same}", flush=True)
        figures[f"cuda_training{name}_ms"] = median_ms(functools.partial(recorded, *fields), 30)
        figures[f"cuda_training_eager{name}_ms"] = median_ms(functools.partial(step, *fields), 30)
        print({key: value for key, value in figures.items() if name in key}, flush=True)
    return figures


def launches() -> Figures:
    """The calls that do without a prepared scene, and the share of a picture's time in which no kernel runs."""
    figures: Figures = {}
    for size in (256, 512):
        boxes, camera = scene(size)
        marcher = Marcher(boxes, DEFAULT)
        busy, _ = kernels_ms(lambda marcher=marcher, camera=camera: marcher(camera))
        whole = median_ms(lambda marcher=marcher, camera=camera: marcher(camera))
        figures[f"cuda_kernels_{size}_ms"] = busy
        figures["cuda_launch_share" if size == 512 else f"cuda_launch_share_{size}"] = max(0.0, 1 - busy / whole)
        figures[f"cuda_pipelined_{size}_ms"] = pipelined_ms(boxes, camera, DEFAULT)
        figures[f"cuda_march_{size}_ms"] = march_ms(boxes, camera, DEFAULT)
        cuda_graph.ENABLED = False
        try:
            figures[f"cuda_eager_{size}_ms"] = march_ms(boxes, camera, DEFAULT)
        finally:
            cuda_graph.ENABLED = True
    return figures


def training_ms(
    boxes: Primitives,
    camera: Camera,
    settings: MarchSettings,
    shapes: Shapes = Shapes(),  # noqa: B008
) -> tuple[float, float]:
    """Milliseconds of a forward pass that saves the backward pass's inputs, and of the backward pass."""
    boxes, camera = leaves(boxes), leaves(camera)
    inputs = [*vars(boxes).values(), camera.intrinsics, camera.world_to_camera]
    forward = median_ms(lambda: march_cuda(boxes, camera, settings, None, shapes))
    picture = march_cuda(boxes, camera, settings, None, shapes)
    outputs = [picture.rgb, picture.alpha, picture.depth]
    weights = [torch.randn_like(output) for output in outputs]
    backward = median_ms(lambda: torch.autograd.grad(outputs, inputs, weights, retain_graph=True))
    return forward, backward


def speed() -> Figures:
    """Milliseconds, and shares of the ceilings."""
    operations, copied, cached = operations_per_second(), copied_bytes_per_second(), cached_bytes_per_second()
    figures: Figures = {
        "cuda_ceiling_tflops": operations / 1e12,
        "cuda_ceiling_copy_tb_per_s": copied / 1e12,
        "cuda_ceiling_cache_read_tb_per_s": cached / 1e12,
    }
    for size in SIZES:
        figures[f"cuda_forward_{size}_ms"] = forward_ms(*scene(size), DEFAULT)
        print(size, figures[f"cuda_forward_{size}_ms"], "ms", flush=True)
    boxes, camera = scene(512)
    figures["cuda_forward_4mm_ms"] = figures["cuda_forward_512_ms"]
    figures["cuda_forward_1mm_ms"] = forward_ms(boxes, camera, FINE)
    for name, settings in (("4mm", DEFAULT), ("1mm", FINE)):
        samples = samples_of(settings)
        seconds = float(figures[f"cuda_forward_{name}_ms"] or 0) / 1e3
        figures[f"samples_{name}"] = samples
        figures[f"cuda_share_of_tflops_{name}"] = samples * OPERATIONS_PER_SAMPLE / operations / seconds
        figures[f"cuda_share_of_cache_read_{name}"] = samples * BYTES_OF_SAMPLE / cached / seconds
        moved = boxes.rgb.nbytes + boxes.density.nbytes + camera.width * camera.height * 6 * 4
        figures[f"cuda_share_of_copy_{name}"] = moved / copied / seconds
        forward, backward = training_ms(boxes, camera, settings)
        figures[f"cuda_forward_keeping_{name}_ms"], figures[f"cuda_backward_{name}_ms"] = forward, backward
        figures[f"cuda_backward_ratio_{name}"] = backward / forward
    figures["cuda_backward_ratio"] = figures["cuda_backward_ratio_4mm"]
    for views in BATCHES:
        figures[f"cuda_forward_{views}_views_ms"] = forward_ms(*scene(512, views), DEFAULT)
        figures[f"cuda_forward_{views}_people_ms"] = forward_ms(*scene(512, views, views), DEFAULT)
    return figures


def exactness() -> Figures:
    """Errors against the reference in float64: largest difference in rgb (0 ... 1), smallest cosine of gradients."""
    boxes, camera = scene(EXACT_SIZE)
    exact = march_reference(first_in_double(boxes), first_in_double(camera))
    figures: Figures = {"cuda_rgb_error_max": float((march_cuda(boxes, camera).rgb[0] - exact.rgb).abs().max())}

    boxes, camera = scene(GRADIENT_SIZE)
    fast = gradients(march_cuda, boxes, camera)
    slow = gradients(march_reference, first_in_double(boxes), first_in_double(camera))
    cosines = {name: float(torch.cosine_similarity(fast[name], slow[name], dim=0)) for name in fast}
    figures |= {f"cuda_gradient_cosine_{name}": cosine for name, cosine in cosines.items()}
    figures["cuda_gradient_cosine_min"] = min(cosines.values())
    return figures


def first_in_double(record: Any) -> Any:
    """The first item of a batch, in float64."""
    return record.to(dtype=torch.float64).map(lambda tensor: tensor[0])


def gradients(draw: Callable[..., Rendering], boxes: Primitives, camera: Camera) -> dict[str, Tensor]:
    """Gradients of a fixed random combination of rgb, alpha and depth."""
    boxes, camera = leaves(boxes), leaves(camera)
    picture = draw(boxes, camera)
    depth = torch.where(picture.alpha > 0.05, picture.depth, 0)
    values = torch.cat([picture.rgb, picture.alpha[..., None], depth[..., None]], dim=-1)
    weights = torch.randn(values.shape[-3:], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (values * weights.to(values)).sum().backward()
    tensors = {**vars(boxes), "intrinsics": camera.intrinsics, "world_to_camera": camera.world_to_camera}
    return {name: tensor.grad.double().flatten() for name, tensor in tensors.items()}


def print_kernels() -> None:
    """Print the time of each kernel in a picture, and in a step of forward and backward pass, from the profiler."""
    boxes, camera = scene(512)
    marcher, recorded = Marcher(boxes, DEFAULT), cuda_graph.Recorded(step_of(DEFAULT, camera))
    fields = tuple(vars(boxes).values())
    for name, call in (("forward", lambda: marcher(camera)), ("training", lambda: recorded(*fields))):
        total, table = kernels_ms(call)
        print(f"{name}: {total:.4f} ms of kernels\n{table}", flush=True)


def cases() -> Figures:
    """Run the tests of the marcher on the device, in as many processes as compile kernels at the same time."""
    spread = ["-n", "8"] if importlib.util.find_spec("xdist") else []
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, "--noconftest"]
    command += ["--rootdir", str(ROOT), *spread, str(ROOT / "tests/backend/march_cuda_cases.py")]
    paths = [str(ROOT / folder) for folder in ("backend", "tests", "tests/backend")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TRITON_INTERPRET": "0"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200)
    print(done.stdout[-6000:], done.stderr[-2000:], flush=True)
    return {"cuda_cases_pass": done.returncode == 0}


def training() -> Figures:
    """Milliseconds of training steps."""
    from train_cuda import training_figures

    return {**training_figures(kernels_ms)}


def variants() -> Iterator[Shapes]:
    """Other program shapes; the first is the default."""
    yield Shapes()
    for tile, samples, warps in (
        ((8, 4), 8, 8), ((8, 4), 4, 4), ((8, 4), 16, 8), ((8, 8), 4, 4), ((8, 8), 8, 8), ((4, 4), 8, 2), ((16, 4), 4, 4)
    ):  # fmt: skip
        for registers in (128, 160, 255):
            yield Shapes(tile=tile, samples=samples, march_warps=warps, march_registers=registers)
    for block, warps in (((8, 8), 2), ((16, 8), 4)):
        yield Shapes(block=block, adjoint_warps=warps)
    for units in (8, 32, 64):
        yield Shapes(blocks_of_unit=units)
    for side in (4, 16):
        yield Shapes(bin=side)


def print_sweep() -> None:
    """Print forward and backward milliseconds of the variants at 512 x 512."""
    boxes, camera = scene(512)
    for shapes in variants():
        forward, backward = training_ms(boxes, camera, DEFAULT, shapes)
        fine = forward_ms(boxes, camera, FINE, shapes)
        print(f"{forward:.3f} {backward:.3f} ms, every millimetre {fine:.3f} ms  {shapes}", flush=True)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--cases", action="store_true", help="also run the tests of the marcher on the device")
    parser.add_argument("--train", action="store_true", help="also time training steps")
    parser.add_argument("--kernels", action="store_true", help="also print the time of each kernel")
    parser.add_argument("--sweep", action="store_true", help="also print the times of other program shapes")
    parser.add_argument("--write-person", type=Path, help="only write the person of the scene there")
    parser.add_argument("--person", type=Path, help="read the person of the scene from there")
    arguments = parser.parse_args()
    if arguments.write_person:
        write_person(arguments.write_person)
        return
    if not torch.cuda.is_available():
        sys.exit("no CUDA device: torch sees none on this machine, so there is nothing to measure")
    if arguments.person:
        made.update(torch.load(arguments.person, weights_only=True))
    figures: Figures = {}
    parts = [exactness, graphs, speed, launches]
    more = ((training, "train"), (cases, "cases"), (print_kernels, "kernels"), (print_sweep, "sweep"))
    parts += [part for part, name in more if getattr(arguments, name)]
    failed = []
    for part in parts:
        began = time.perf_counter()
        try:
            figures |= part() or {}
        except Exception:
            traceback.print_exc()
            failed.append(part.__name__)
        print(f"-- {part.__name__}: {time.perf_counter() - began:.1f} s", flush=True)
        report(figures, arguments.json)
    if failed:
        sys.exit(f"these parts failed: {', '.join(failed)}")


def median_ms(call: Callable[[], object], repeats: int = 50, warm_up: int = 5) -> float:
    """Median milliseconds between CUDA events around a call, with the time that the host takes to launch it."""
    for _ in range(warm_up):
        call()
    torch.cuda.synchronize()
    times = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        call()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    return statistics.median(times)


@triton.jit
def _multiply_add(out, rounds, LANES: tl.constexpr):
    lane = tl.program_id(0) * LANES + tl.arange(0, LANES)
    x = lane.to(tl.float32) * 1e-9 + 0.999
    a, b, c, d = x, x + 0.1, x + 0.2, x + 0.3
    e, f, g, h = x + 0.4, x + 0.5, x + 0.6, x + 0.7
    for _ in range(rounds):
        for _ in tl.static_range(8):
            a, b, c, d = a * x + 0.001, b * x + 0.001, c * x + 0.001, d * x + 0.001
            e, f, g, h = e * x + 0.001, f * x + 0.001, g * x + 0.001, h * x + 0.001
    tl.store(out + lane, a + b + c + d + e + f + g + h)


@triton.jit
def _read(source, out, blocks, rounds, LANES: tl.constexpr):
    lane = tl.arange(0, LANES)
    total = tl.zeros((LANES,), tl.float32)
    for i in range(rounds):
        block = (tl.program_id(0) + i * 37) % blocks
        total += tl.load(source + block * LANES + lane, cache_modifier=".cg")
    tl.store(out + tl.program_id(0) * LANES + lane, total)


def operations_per_second() -> float:
    """float32 operations per second; a fused multiply-add counts as two."""
    programs = 64 * torch.cuda.get_device_properties(0).multi_processor_count
    out = torch.empty(programs * LANES, device="cuda")
    ms = median_ms(lambda: _multiply_add[(programs,)](out, ROUNDS, LANES=LANES, num_warps=4), 20)
    return programs * LANES * CHAINS * 8 * ROUNDS * 2 / ms * 1e3


def copied_bytes_per_second() -> float:
    """Bytes read plus bytes written per second by a copy in device memory much larger than the caches."""
    source = torch.rand(COPIED_BYTES // 4, device="cuda")
    target = torch.empty_like(source)
    return 2 * COPIED_BYTES / median_ms(lambda: target.copy_(source), 20) * 1e3


def cached_bytes_per_second() -> float:
    """Bytes per second read from the second-level cache, bypassing the first level."""
    lanes = 4 * LANES
    source = torch.rand(RESIDENT_BYTES // 4, device="cuda")
    blocks = source.numel() // lanes
    programs = 16 * torch.cuda.get_device_properties(0).multi_processor_count
    out = torch.empty(programs * lanes, device="cuda")
    ms = median_ms(lambda: _read[(programs,)](source, out, blocks, ROUNDS, LANES=lanes, num_warps=8), 20)
    return 4 * programs * lanes * ROUNDS / ms * 1e3


if __name__ == "__main__":
    main()
