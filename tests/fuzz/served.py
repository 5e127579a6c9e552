"""Every request of the child, run by the real server in this process; see `targets`."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from fuzz import mutations
from fuzz.target import Garbage, Target

LONGEST_S = 8.0
"""Of a request that is valid after all; the slowest takes two."""
OUT = "made"
"""The folder that requests write to."""
OUTPUTS = {"out": "made/x", "out_dir": "made", "depth": "made/depth.png", "frame": "a.frame"}
"""Parameters that name what is written, which stays in the folder of the fuzz run."""
BAD_OUTPUTS = ("taken", "taken/x", "a.human.safetensors", "n" * 300, "", "\0", 3, None, [], "made")
BAD_INPUTS = ("cut.safetensors", "cut.npz", "cut.json", "empty", "nowhere", "taken", "pipe", "/dev/zero",
              "/proc/self/mem", "a.human.safetensors", "captures", "n" * 300, "\0", "//server/x")  # fmt: skip
STILL = np.eye(4)[:3].tolist()


def inputs(folder: Path) -> None:
    """Valid inputs of requests by their relative names, and damaged ones; the current folder is `folder`'s."""
    from capture_scenes import captured
    from primdiffusion.human import generate
    from primdiffusion.human_file import save_human
    from tiny_encoder import save_tiny_encoder
    from tiny_model import save_tiny_checkpoint, tiny_model

    from fuzz.data_targets import make_solids, make_weights
    from fuzz.other_files import CAMERA, make_photograph

    for seed, name in enumerate(("a", "b")):
        save_human(folder / f"{name}.human.safetensors", generate(tiny_model(), seed=seed, steps=2))
    save_tiny_checkpoint(folder / "tiny.safetensors")
    save_tiny_encoder(folder / "encoder.safetensors")
    shutil.move(captured(folder / "rendered", people=1, frames=1), folder / "captures")
    shutil.copy(make_photograph(folder), folder / "mask.png")
    (folder / "cameras.json").write_text(json.dumps({"camera0000": CAMERA}), encoding="utf-8")
    make_weights(folder)
    make_solids(folder)
    (folder / "pose.json").write_text(json.dumps([0.1] * 72), encoding="utf-8")
    np.zeros(16 * 16 * 5, np.float32).tofile(folder / "a.frame")
    for name, whole in (("safetensors", "a.human.safetensors"), ("npz", "weights.npz"), ("json", "pose.json")):
        content = (folder / whole).read_bytes()
        (folder / f"cut.{name}").write_bytes(content[: len(content) // 2])
    (folder / "empty").touch()
    (folder / "taken").mkdir()
    (folder / "taken" / "kept.txt").write_text("a user's file", encoding="utf-8")
    os.mkfifo(folder / "pipe")


SAMPLED: dict[str, Any] = {"out_dir": "made", "steps": 2, "size": 16, "checkpoint": "tiny.safetensors"}
PERSON = {"person": "a.human.safetensors"}
ASKED = {"attributes": {"outfit": "suit", "height": 1.7}, "guidance": 1.5, "seed": 3}
POSED = {"human": "a.human.safetensors", "object": STILL, "joints": [STILL] * 24, "betas": [0.5] * 10}
CALLS: dict[str, dict[str, Any]] = {
    "generate": {**SAMPLED, **ASKED, "sampler": "ddim", "picture_px": 8},
    "variations": {**SAMPLED, "seeds": [1, 2], "attributes": {"outfit": "suit"}, "person": None, "amount": 0.5},
    "attributes": {"checkpoint": "tiny.safetensors"},
    "vary": {**SAMPLED, **PERSON, **ASKED, "amount": 0.5},
    "interpolate": {**SAMPLED, **PERSON, "other": "b.human.safetensors", "fraction": 0.5},
    "inpaint": {**SAMPLED, **PERSON, **ASKED, "weights": "weights.npz", "masking": "repaint"},
    "transfer": {
        **SAMPLED, **PERSON, "source": "b.human.safetensors", "region": ["top", "left_hand"], "what": "texture",
        "harmonise": 0.2, "seed": 3,
    },
    "reconstruct": {
        "capture": "captures", "out_dir": "made", "subject": None, "frame": 0, "views": 2,
        "checkpoint": "encoder.safetensors", "size": 16,
    },
    "fit_posture": {
        "pictures": ["anna.png"], "masks": ["mask.png"], "pose": "pose.json", "cameras": "cameras.json",
        "out_dir": "made", "checkpoint": "tiny.safetensors",
    },
    "render": {
        "human": "a.human.safetensors", "out": "made/x.png", "width": 16, "height": 16, "yaw_degrees": 30,
        "pose": "pose.json", "depth": "made/depth.png",
    },
    "draw": {
        "frame": "a.frame", "width": 16, "height": 16, "region": [0, 0, 16, 16], "clip": [0.1, 100.0],
        "intrinsics": [[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]], "world_to_camera": [*STILL[:2], [0, 0, 1, 3.0]],
        "people": [POSED], "solids": "solids.npz", "background": [0.1, 0.2, 0.3], "view": "colour", "step": 0.02,
    },
    "merge": {"people": [POSED], "out": "made/x.npz", "voxel": 0.1},
    "merge_frames": {"people": [POSED, POSED], "out_dir": "made", "voxel": 0.1},
    "proxy": {**PERSON, "out_dir": "made", "betas": [0.5] * 10, "triangles": 500, "texture_px": 64, "spacing": 0.05},
    "gaussians": {
        **PERSON, "out": "made/x.ply", "object": STILL, "joints": [STILL] * 24, "betas": [0.5] * 10, "limit": 50,
    },
    "open_human": {**PERSON, "out_dir": "made", "size": 16},
    "hello": {},
    "cancel": {"id": 1},
    "shutdown": {},
}  # fmt: skip
"""Parameters of each method; a test compares the names with the server's."""


def call(method: str, params: dict[str, Any]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        message = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        (folder / "call.json").write_text(json.dumps(message), encoding="utf-8")
        return folder / "call.json"

    return make


def parameter(content: bytes, rng: Generator) -> bytes:
    """A parameter, or a number deep in it, becomes a hostile one; or it is missing or unknown."""
    message = json.loads(content)
    params = message["params"]
    if not params:
        return mutations.as_json(content, rng)
    name = mutations.pick(rng, list(params))
    chance = rng.random()
    if name in OUTPUTS:
        params[name] = mutations.pick(rng, BAD_OUTPUTS)
    elif isinstance(params[name], dict | list) and chance < 0.6:
        params[name] = mutations.tree(params[name], rng)
    elif isinstance(params[name], str) and chance < 0.6:
        params[name] = mutations.pick(rng, BAD_INPUTS)
    elif chance < 0.9:
        params[name] = mutations.pick(rng, mutations.VALUES)
    elif chance < 0.95:
        del params[name]
    else:
        params[f"{name} "] = 1
    return json.dumps(message).encode()


def contained(line: bytes) -> bytes:
    """The line, with outputs that no mutation may send out of the folder of the fuzz run."""
    try:
        message = json.loads(line)
        params = message["params"]
        wild = [name for name in OUTPUTS if isinstance(params.get(name), str) and params[name] not in BAD_OUTPUTS]
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return line
    if not wild:
        return line
    for name in wild:
        if ".." in params[name] or os.path.isabs(params[name]):
            params[name] = OUTPUTS[name]
    return json.dumps(message).encode()


@functools.cache
def session():
    """One for all requests, as in the child; a fit to pictures takes one step of each kind."""
    from primdiffusion import from_pictures
    from primdiffusion.commands.session import Session
    from primdiffusion.posture.fit import Stage

    from_pictures.ROUNDS = (from_pictures.Round(32, Stage(1, 0.04), 1),)

    return Session()


@functools.cache
def place() -> Path:
    """The folder with the inputs."""
    folder = Path("served").absolute()
    folder.mkdir()
    inputs(folder)
    return folder


class Lines(io.BytesIO):
    """The input of a server that runs the requests it has taken whenever an empty line comes, and at the end."""

    server: Any

    def readline(self, size: int | None = -1, /) -> bytes:
        line = super().readline(size)
        if not line.strip() and not self.server._queue.empty():
            self.server._run_request(session(), self.server._queue.get())
        return line


def answers(content: bytes) -> list[dict[str, Any]]:
    """What the server answers to lines, and after having run the requests in them."""
    from primdiffusion.serve.server import Server, Wire

    sent, lines = io.BytesIO(), Lines(content)
    lines.server = server = Server(lines, Wire(sent))
    server._end = lambda: None  # which would end this process
    server._read()
    return [message for message in map(json.loads, sent.getvalue().splitlines()) if "method" not in message]


@contextlib.contextmanager
def in_place() -> Iterator[None]:
    """In the folder with the inputs, whose files stay as they are. Raises Garbage for a user's file that is changed."""
    before, folder = Path.cwd(), place()
    os.chdir(folder)
    Path(OUT).mkdir(exist_ok=True)
    try:
        yield
        if (folder / "taken" / "kept.txt").read_text(encoding="utf-8") != "a user's file":
            raise Garbage("a user's file was changed")
        if left := [name for name in os.listdir(folder) if "partial" in name]:
            raise Garbage(f"{left[0]} was left over")
    finally:
        os.chdir(before)
        shutil.rmtree(folder / OUT, ignore_errors=True)
        for name in BAD_OUTPUTS:
            if isinstance(name, str) and name.startswith("n"):
                shutil.rmtree(folder / name, ignore_errors=True)
        for made in (folder / "taken").iterdir():
            if made.name != "kept.txt":
                shutil.rmtree(made, ignore_errors=True) if made.is_dir() else made.unlink()


def read_call(path: Path) -> None:
    """Raises as `read_lines`."""
    line = contained(path.read_bytes()).replace(b"\n", b" ")
    with in_place():
        _check(line, answers(line))


def read_lines(path: Path) -> None:
    """Raises the last error that the child answers as an RpcError, Garbage for too many or too few answers and for a
    user's file that is changed."""
    content = b"\n".join(map(contained, path.read_bytes().split(b"\n")))
    with in_place():
        _check(content, answers(content))


def _check(content: bytes, found: list[dict[str, Any]]) -> None:
    from primdiffusion.serve.server import INTERNAL_ERROR, RpcError

    expected = sum(map(_is_answered, content.split(b"\n")))
    if len(found) != expected:
        raise Garbage(f"{len(found)} answers instead of {expected}")
    errors = [message["error"] for message in found if "error" in message]
    for error in sorted(errors, key=lambda error: error["code"] == INTERNAL_ERROR)[-1:]:
        if error["code"] == INTERNAL_ERROR:
            raise AssertionError(error["message"])
        remedy = (error.get("data") or {}).get("remedy", "")
        raise RpcError(error["code"], f"{error['message']}: {remedy}" if remedy else error["message"])


def _is_answered(line: bytes) -> bool:
    from primdiffusion.serve.server import RpcError, parse_request

    try:
        return bool(line.strip()) and parse_request(line).wants_response
    except RpcError:
        return True


TARGETS = tuple(
    Target(
        f"request {method}", call(method, params), (*[parameter] * 5, mutations.flip, mutations.truncate), read_call,
        is_file=False, seconds=LONGEST_S,
    )
    for method, params in CALLS.items()
)  # fmt: skip
