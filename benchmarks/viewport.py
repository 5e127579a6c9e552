"""Measures the marcher on the viewport's GPU: milliseconds a picture with 1, 3 and 10 humans, and its error.

`python benchmarks/viewport.py --blender .venv52/bin/python --json viewport.json` generates a human, and marches it in
Blender 5.2 or later without a window, as a Python module or as an application: 1920 x 1080 pixels on a GPU, an eighth
of them on a processor. viewport_error_999 is the 99.9th percentile over pixels of the largest difference from the
backend's picture, in linear colours and alpha; viewport_ms_10 the median time of a picture with 10 humans, from boxes
in memory to a finished texture, the camera turning between pictures. viewport_ms_1080p_gpu is that for 1 human per
picture, null on a processor.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PEOPLE = (1, 3, 10)
SIZE, SMALL = (1920, 1080), (680, 382)
STEP, SPACING_M, PICTURES = 0.004, 1.1, 12
PROCESSORS = ("llvmpipe", "softpipe", "SwiftShader")


def camera(count: int, size: tuple[int, int], turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics and world-to-camera of a camera that sees a row of humans, turned about the vertical axis."""
    distance = 4.0 + 0.7 * (count - 1)
    focal = 1.9 * size[1] * distance / 4.0 / max(1.0, count * SPACING_M * size[1] / size[0] / 2.1)
    ahead = np.array([-np.sin(turn), 0.0, -np.cos(turn)])
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    turned = np.stack([right, [0.0, -1.0, 0.0], ahead])
    intrinsics = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return intrinsics, np.concatenate([turned, -(turned @ (-distance * ahead))[:, None]], 1)


def in_blender(folder: Path) -> None:
    """The half that Blender runs: marches `boxes.npz`, writes `figures.json` and `picture.npy`."""
    import contextlib

    with contextlib.suppress(ImportError):
        import bpy  # noqa: F401  a module brings `gpu` only when it is loaded
    import gpu

    sys.path.insert(0, str(ROOT))
    from blender_primdiffusion.engine.boxes import Boxes
    from blender_primdiffusion.engine.gpu.march import GpuMarcher, GpuPayload
    from blender_primdiffusion.engine.view import PinholeView

    gpu.init()
    renderer = gpu.platform.renderer_get()
    size = SMALL if any(name in renderer for name in PROCESSORS) else SIZE
    with np.load(folder / "boxes.npz") as stored:
        human = dict(stored)
    payload, marcher = GpuPayload(human["rgb"], human["density"]), GpuMarcher()
    figures: dict[str, object] = {
        "viewport_gpu": f"{renderer}, {gpu.platform.backend_type_get()} {gpu.platform.version_get()}",
        "viewport_pixels": size[0] * size[1],
    }
    for count in PEOPLE:
        people = [
            (payload, Boxes(human["position"] + np.float32([x, 0, 0]), human["rotation"], human["half_extent"]))
            for x in (np.arange(count) - (count - 1) / 2) * SPACING_M
        ]
        times = []
        for number in range(PICTURES):
            view = PinholeView(*camera(count, size, 0.05 * number), (0.01, 100.0), *size)
            began = time.perf_counter()
            march = marcher.march(people, view, STEP)
            march.advance()
            march.wait()
            times.append(1000 * (time.perf_counter() - began))
            if count == 1 and number == 0:
                np.save(folder / "picture.npy", np.array(march.colour.read()).reshape(size[1], size[0], 4)[::-1])
        figures[f"viewport_ms_{count}"] = round(statistics.median(times[2:]), 2)
    figures["viewport_ms_1080p_gpu"] = figures["viewport_ms_1"] if size == SIZE else None
    (folder / "figures.json").write_text(json.dumps(figures), encoding="utf-8")


def main() -> None:
    import torch
    from primdiffusion.body.model import BodyPose
    from primdiffusion.diffusion.checkpoint import load_checkpoint
    from primdiffusion.geometry.camera import Camera
    from primdiffusion.human import generate, place
    from primdiffusion.render.march import march
    from record import command_line, report

    parser = command_line(__doc__)
    parser.add_argument(
        "--blender", type=Path, required=True, help="Blender, or a Python with its module, 5.2 or later"
    )
    parser.add_argument("--seed", type=int, default=3)
    arguments = parser.parse_args()
    primitives = place(generate(load_checkpoint(), arguments.seed), BodyPose.rest())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "boxes.npz", **{key: tensor.numpy() for key, tensor in vars(primitives).items()})
        words = [str(arguments.blender), str(Path(__file__)), "--in-blender", str(folder)]
        if "python" not in arguments.blender.name:
            words[1:2] = ["-b", "--factory-startup", "--python", words[1], "--"]
        subprocess.run(words, check=True, stdout=sys.stderr)
        figures = json.loads((folder / "figures.json").read_text(encoding="utf-8"))
        drawn = np.load(folder / "picture.npy")
    size = (drawn.shape[1], drawn.shape[0])
    matrices = (torch.from_numpy(matrix).float() for matrix in camera(1, size, 0.0))
    wanted = march(primitives, Camera(*matrices, *size))
    error = np.abs(drawn - torch.cat([wanted.rgb, wanted.alpha[..., None]], -1).numpy()).max(-1)
    figures |= {"viewport_error_999": float(np.quantile(error, 0.999)), "viewport_error_max": float(error.max())}
    report(figures, arguments.json)


if __name__ == "__main__":
    if "--in-blender" in sys.argv:
        in_blender(Path(sys.argv[-1]))
    else:
        main()
