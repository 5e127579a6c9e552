"""Small files that claim much: each is read in a process of its own, whose peak of memory and time are measured.

`measure` starts one process, `python -m fuzz.small_inputs NAME ...`, which loads the readers' modules and forks for
each input: a fork has what is loaded, and its peak begins anew.
"""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from fuzz.claims import GREY
from fuzz.run import FOLDERS, ROOT, _memory_mb
from fuzz.small_captures import captured_view, read_rgba, read_view, small_view
from fuzz.small_files import (
    bvh,
    captured_poses,
    glb,
    many_corners,
    many_faces,
    matrices,
    motion,
    negative_variants,
    payload,
    picture,
    read_asset,
    read_body,
    read_capture,
    read_captured_poses,
    read_glb,
    read_motion,
    read_payload,
    read_pose,
    read_poses,
    read_shards,
    read_shots,
    read_weights,
    repeated_shard,
    scanned_picture,
    shared_lists,
    small_body,
    small_glb,
    small_motion,
    small_pickle,
    small_picture,
    small_shards,
    weights,
)
from fuzz.target import said

SMALL_BYTES = 1_000_000
"""Size below which an input must stay within `MOST_MEMORY_MB`."""
PROTECTION = 6 * 2**30
"""Bytes of data that a measured process may have: a reader without a limit must not take the machine down."""
WAIT_S = 300.0


@dataclasses.dataclass(frozen=True)
class SmallInput:
    """An input below `SMALL_BYTES` that claims gigabytes or minutes."""

    make: Callable[[Path], Path]
    """Writes it into a folder, without much memory of its own, and returns the path that `read` gets."""
    read: Callable[[Path], object]
    warm: Callable[[Path], Path]
    """Writes an ordinary file of the same kind: reading it first loads modules, the body and compiled kernels."""
    kind: str
    """What is tested together."""
    is_read: bool = False
    """Whether the input must be readable; otherwise it may also be rejected in one sentence."""


@dataclasses.dataclass(frozen=True)
class Measured:
    """What reading one input took."""

    bytes: int
    """Size of the input."""
    peak_mb: float
    """Growth of the process's resident memory at its peak, MB; 0 on other systems than Linux."""
    seconds: float
    sentence: str
    """The error that the reader gave; empty if the input was read."""
    is_user_error: bool
    """Whether it was read, or rejected in a sentence; False for an error that would be shown with a traceback."""


def measure(names: Sequence[str]) -> dict[str, Measured]:
    """Read inputs, each in a process of its own. Raises subprocess.SubprocessError if one ends or hangs."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*FOLDERS, ROOT / "backend")))}
    command = [sys.executable, "-m", "fuzz.small_inputs", *names]
    wait_s = WAIT_S * (1 + len(names))
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, timeout=wait_s, check=True)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith(b"{")]
    return {line.pop("name"): Measured(**line) for line in lines}


def figures() -> dict[str, float]:
    """The largest peak and the longest time of all inputs, as benchmarks/faults.py records them."""
    measured = measure(list(INPUTS)).values()
    return {
        "small_inputs": len(measured),
        "small_input_peak_mb": round(max(one.peak_mb for one in measured), 1),
        "small_input_seconds": round(max(one.seconds for one in measured), 2),
    }


def main(names: Sequence[str]) -> None:
    """Measure inputs and print a line of JSON for each. Raises ChildProcessError for a fork that ends otherwise."""
    import torch

    torch.set_num_threads(1)  # a fork has none of the other threads
    loaded = set()
    for name in names:
        chosen = INPUTS[name]
        with tempfile.TemporaryDirectory(prefix="primdiffusion_small_") as temporary:
            warm, small = Path(temporary, "warm"), Path(temporary, "small")
            warm.mkdir()
            small.mkdir()
            ordinary = chosen.warm(warm)
            if (chosen.read, chosen.warm) not in loaded:
                chosen.read(ordinary)
                loaded.add((chosen.read, chosen.warm))
            fork = os.fork()
            if fork == 0:
                chosen.read(ordinary)  # a fork maps libraries anew, as it uses them: their pages are not the input's
                _measure_here(name, small)
                os._exit(0)
            if os.waitpid(fork, 0)[1]:
                raise ChildProcessError(f"{name}: the process that read it was ended")


def _measure_here(name: str, folder: Path) -> None:
    path = INPUTS[name].make(folder)
    resource.setrlimit(resource.RLIMIT_DATA, (PROTECTION, PROTECTION))
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before, began = _memory_mb("VmRSS"), time.perf_counter()
    error: BaseException | None = None
    try:
        INPUTS[name].read(path)
    except Exception as caught:
        error = caught
    seconds, grown = time.perf_counter() - began, _memory_mb("VmHWM") - before
    sentence = "" if error is None else said(error)
    shown = f"{type(error).__name__}: {error}" if sentence is None else sentence
    about = Measured(
        bytes=path.stat().st_size,
        peak_mb=round(grown, 1),
        seconds=round(seconds, 2),
        sentence=shown.replace(f"{folder}{os.sep}", ""),
        is_user_error=sentence is not None,
    )
    print(json.dumps({"name": name, **dataclasses.asdict(about)}), flush=True)


_WHOLE = 63 * 2**20
_QUARTER = [("poses", "f4", (55_000, 72)), ("trans", "f4", (55_000, 3))]
"""Fifteen minutes of AMASS."""
_NOISY = [("poses", "i1", (1_800_000, 72))]
_SEVEN = [
    (name, "f4", (_WHOLE // 288, 72))
    for name in ("poses", "pose", "theta", "fullpose", "global_orient", "trans", "transl")
]
INPUTS: dict[str, SmallInput] = {
    "glb of 64 materials": SmallInput(glb(1400, 64), read_glb, small_glb, "meshes", is_read=True),
    "glb of 64 tinted materials": SmallInput(glb(1400, 64, tinted=True), read_glb, small_glb, "meshes"),
    "glb of 100 parts": SmallInput(glb(4096, 1, nodes=100), read_glb, small_glb, "meshes", is_read=True),
    "glb of a huge picture": SmallInput(glb(8192, 2, tinted=True), read_glb, small_glb, "meshes"),
    "glb of a large picture": SmallInput(glb(6400, 1), read_glb, small_glb, "meshes"),
    "glb of many corners": SmallInput(many_corners, read_glb, small_glb, "meshes"),
    "asset": SmallInput(picture(8192, 8192), read_asset, small_picture, "pictures"),
    "asset just below the limit": SmallInput(picture(6470, 6470), read_asset, small_picture, "pictures"),
    "asset of many scans": SmallInput(scanned_picture, read_asset, small_picture, "pictures"),
    "shot": SmallInput(picture(8192, 8192), read_shots, small_picture, "pictures"),
    "shot just below the limit": SmallInput(picture(6470, 6470), read_shots, small_picture, "pictures"),
    "captured image": SmallInput(picture(8192, 8192), read_capture("img"), small_picture, "pictures"),
    "captured normal": SmallInput(picture(3700, 3700), read_capture("normal"), small_picture, "pictures", is_read=True),
    "captured normal, huge": SmallInput(picture(7000, 7000), read_capture("normal"), small_picture, "pictures"),
    "captured mask": SmallInput(
        picture(8192, 8192, GREY), read_capture("mask"), small_picture, "pictures", is_read=True
    ),
    "captured depth": SmallInput(
        picture(6470, 6470, GREY, 16), read_capture("depth"), picture(64, 64, GREY, 16), "pictures", is_read=True
    ),
    "captured view": SmallInput(captured_view(6400, "img", "mask", "depth", "part"), read_view, small_view, "views"),
    "captured view just below the limit": SmallInput(
        captured_view(5750, "img", "mask", "depth", "part"), read_view, small_view, "views", is_read=True
    ),
    "captured view of all passes": SmallInput(
        captured_view(3700, "img", "mask", "depth", "normal", "part"), read_view, small_view, "views", is_read=True
    ),
    "captured view of colour and mask": SmallInput(
        captured_view(6400, "img", "mask"), read_rgba, small_view, "views", is_read=True
    ),
    "motion": SmallInput(motion(("poses", "f4", (_WHOLE // 288, 72))), read_motion, small_motion, "motion"),
    "motion of bytes": SmallInput(motion(("poses", "i1", (_WHOLE // 72, 72))), read_motion, small_motion, "motion"),
    "motion just below the limit": SmallInput(motion(*_QUARTER), read_motion, small_motion, "motion", is_read=True),
    "motion of matrices": SmallInput(matrices(_WHOLE // 216), read_motion, small_motion, "motion"),
    "motion of matrices just below the limit": SmallInput(
        matrices(18_000), read_motion, small_motion, "motion", is_read=True
    ),
    "motion of seven arrays": SmallInput(motion(*_SEVEN), read_motion, small_motion, "motion"),
    "poses": SmallInput(motion(("poses", "f4", (_WHOLE // 288, 72))), read_poses, small_motion, "motion"),
    "poses just below the limit": SmallInput(motion(*_QUARTER), read_poses, small_motion, "motion", is_read=True),
    "poses of bytes": SmallInput(motion(("poses", "i1", (_WHOLE // 72, 72))), read_poses, small_motion, "motion"),
    "poses of bytes and noise": SmallInput(motion(*_NOISY, noise=4_000_000), read_poses, small_motion, "motion"),
    "motion of bytes and noise": SmallInput(motion(*_NOISY, noise=4_000_000), read_motion, small_motion, "motion"),
    "pose of bytes and noise": SmallInput(
        motion(*_NOISY, noise=4_000_000), read_pose, small_motion, "motion"
    ),
    "captured poses": SmallInput(
        captured_poses(55_000), read_captured_poses, captured_poses(2), "motion", is_read=True
    ),
    "captured poses of bytes": SmallInput(captured_poses(850_000), read_captured_poses, captured_poses(2), "motion"),
    "pose of bytes": SmallInput(
        motion(("poses", "i1", (_WHOLE // 72, 72))), read_pose, small_motion, "motion"
    ),
    "bvh of many frames": SmallInput(bvh(480_000), read_motion, bvh(4), "motion"),
    "bvh of many joints": SmallInput(bvh(5000, extra=900), read_motion, bvh(4), "motion"),
    "bvh just below the limit": SmallInput(bvh(34_000), read_motion, bvh(4), "motion", is_read=True),
    "repeated shard": SmallInput(repeated_shard, read_shards, small_shards, "people"),
    "negative colourings": SmallInput(negative_variants, read_shards, small_shards, "people"),
    "payload": SmallInput(payload(30, 0), read_payload, payload(1, 0), "people", is_read=True),
    "payload of scales": SmallInput(payload(1, 10_000), read_payload, payload(1, 0), "people"),
    "body of many faces": SmallInput(many_faces, read_body, small_body, "people"),
    "body of shared lists": SmallInput(shared_lists, read_body, small_pickle, "people"),
    "weights of bytes and noise": SmallInput(weights(150_000_000, 4_000_000), read_weights, weights(100), "people"),
}  # fmt: skip
if __name__ == "__main__":
    main(sys.argv[1:])
