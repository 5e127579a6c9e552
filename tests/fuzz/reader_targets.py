"""Inputs that two readers must judge alike, and whole conversations of the extension with its child; see `targets`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.random import Generator
from primdiffusion.formats.answers import Progress

from fuzz import extension_targets, mutations, served
from fuzz.mutations import Mutation
from fuzz.target import Garbage, Target
from fuzz.verdicts import DRAFT_MUTATIONS, Draft, difference, draft, drafted

# --- both readers of .human files


def make_tensors(folder: Path) -> Path:
    (folder / "a.human").write_bytes(draft(np.random.default_rng(1)).content())
    return folder / "a.human"


def read_tensors(path: Path) -> None:
    """As the safetensors library, and the readers of both programs."""
    if reason := difference(path, path.read_bytes())[1]:
        raise Garbage(reason)


def of_draft(change: Callable[[Draft, Generator], None]) -> Mutation:
    def mutation(content: bytes, rng: Generator) -> bytes:
        file = drafted(content)
        change(file, rng)
        return file.content()

    return mutation


def read_by_both(path: Path) -> None:
    """By the extension, which leaves humans on a body of the user's to the backend, and by the backend."""
    from primdiffusion.human_file import load_human

    from blender_primdiffusion.scene.human_file import read_tensors
    from blender_primdiffusion.scene.rest_human import read_human

    in_extension = in_backend = None
    try:
        if "body" in read_tensors(path).metadata:
            return
        read_human(path)
    except ValueError as error:
        in_extension = error
    try:
        load_human(path)
    except ValueError as error:
        in_backend = error
    if (in_extension is None) != (in_backend is None):
        raise Garbage(f"one reader alone rejects it: {in_extension or in_backend}")
    if in_backend is not None:
        raise in_backend


# --- lines in both directions


def make_requests(folder: Path) -> Path:
    """Requests, each with an empty line behind it so that it is run before the next one comes, and a notification."""
    lines = [json.dumps({"jsonrpc": "2.0", "method": "cancel", "params": {"id": 1}})]
    for id, name in enumerate(("hello", "attributes", "cancel", "render", "merge")):
        lines += [json.dumps({"jsonrpc": "2.0", "id": id, "method": name, "params": served.CALLS[name]}), ""]
    (folder / "requests.json").write_text("\n".join(lines), encoding="utf-8")
    return folder / "requests.json"


RESULTS: dict[str, dict[str, Any]] = {
    "generate": {"person": "a.human", "seconds": 0.5},
    "reconstruct": {"person": "a.human", "seconds": 0.5, "warnings": ["few views"]},
    "variations": {
        "people": [{"seed": 3, "person": "a.human", "picture": "a.png"}], "seconds": 0.1,
    },
    "merge_frames": {"files": ["a.npz"], "seconds": 1},
    "proxy": {"proxy": "a.npz", "texture": "a.png", "betas": [0.5] * 10, "triangles": 500, "seconds": 2.5},
    "hello": {
        "name": "primdiffusion", "version": "1", "protocol": 1, "pid": 7, "python": "3.11", "executable": "python",
        "memory_gb": 8.5, "ready": False, "problem": None, "device": None, "device_name": None,
    },
}  # fmt: skip
"""Of the child, by method; the place of a method, from 1, is the id of its request."""


def make_answers(folder: Path) -> Path:
    progress = {"id": 1, "stage": "sample", "step": 1, "total": 4, "eta_s": 0.5, "picture": None}
    error = {"code": -32002, "message": "no", "data": {"kind": "bad_input", "remedy": "try again"}}
    messages: list[dict[str, Any]] = [
        {"method": "ready", "params": {"ready": True, "problem": None, "device": "cpu", "device_name": None}},
        {"method": "heartbeat"},
        {"method": "progress", "params": progress},
        *({"id": id, "result": result} for id, result in enumerate(RESULTS.values(), 1)),
        {"id": len(RESULTS) + 1, "error": error},
    ]
    lines = [json.dumps({"jsonrpc": "2.0", **message}) for message in messages]
    (folder / "answers.json").write_text("\n".join(["a warning of torch", *lines, ""]), encoding="utf-8")
    return folder / "answers.json"


def read_answers(path: Path) -> None:
    """By the extension's client, whose child has written this and ended: it dies once, whatever it has said."""
    from blender_primdiffusion.backend.child_process import Output
    from blender_primdiffusion.backend.client import BackendClient, Died, Notification, Response

    client: Any = BackendClient(path)
    client._output, client._errors = Output(), Output()
    client._process = SimpleNamespace(poll=lambda: 0, kill=lambda: None, wait=lambda _: 0)
    client._hello = list(RESULTS).index("hello") + 1
    client._asked = {id: method for id, method in enumerate((*RESULTS, "vary"), 1)}
    with client._output.target as output, client._errors.target:
        output.write(path.read_bytes())
    events: list[Any] = []
    for _ in range(10_000):
        events += client.poll()
        if client._ended:
            break
    if [event for event in events if isinstance(event, Died)] != events[-1:]:
        raise Garbage("a child that has ended has not died once, at last")
    for event in events:
        if isinstance(event, Notification) and event.method == "progress":
            shown(event.params)
        if isinstance(event, Response) and event.id == list(RESULTS).index("variations") + 1:
            for files in event.result.people:
                int(files.seed)
                [path.exists() for path in (files.person, files.picture)]
    answered = [event.id for event in events if isinstance(event, Response)]
    if len(answered) != len(set(answered)):
        raise Garbage("an answer was taken twice")


def shown(progress: Progress) -> None:
    """As jobs show it."""
    f"{progress.stage.capitalize()} {progress.step / progress.total:.0%}".encode()
    (progress.picture or Path("x")).exists()


def line_of(mutation: Mutation) -> Mutation:
    """Damage one line of several."""

    def damage(content: bytes, rng: Generator) -> bytes:
        lines = content.split(b"\n")
        place = int(rng.integers(len(lines)))
        lines[place] = mutation(lines[place], rng)
        return b"\n".join(lines)

    return damage


LINES: tuple[Mutation, ...] = (
    *[line_of(mutations.as_json)] * 4, mutations.lines, mutations.lines, line_of(mutations.words), mutations.flip,
    mutations.truncate,
)  # fmt: skip

TARGETS = (
    Target("readers of tensors", make_tensors, (*map(of_draft, DRAFT_MUTATIONS), *mutations.PLAIN), read_tensors),
    Target("readers of a human", extension_targets.make_human, mutations.SAFETENSORS, read_by_both),
    Target("readers of a compact human", extension_targets.make_compact, mutations.SAFETENSORS, read_by_both),
    Target("lines of the child", make_answers, LINES, read_answers, is_file=False),
    Target("lines to the child", make_requests, LINES, served.read_lines, is_file=False, seconds=served.LONGEST_S),
)
