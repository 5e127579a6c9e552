"""A child that makes people of FAKE_HUMAN's file, edits them and draws one colour, or misbehaves."""

import json
import os
import shutil
import sys
import threading
import time
from pathlib import Path

import numpy as np

DIES, FAILS, GIVES_GARBAGE, TAKES_LONG = 1, 2, 3, 4
IGNORES_CANCEL, NO_MEMORY = 105, 106
BANDS = 4
COLOUR, DEPTH = (0.25, 0.5, 0.75, 1.0), 3.0
_lock = threading.Lock()


def say(**message) -> None:
    with _lock:
        print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)


def generate(id: int, params: dict, cancelled: threading.Event) -> None:
    seed, steps, out = params["seed"], params["steps"], Path(params["out_dir"])
    for step in range(steps * (100 if seed == TAKES_LONG else 1)):
        progress = {"id": id, "stage": "sample", "step": min(step, steps), "total": steps, "eta_s": 1.0}
        if params.get("picture_px"):
            progress["picture"] = str(Path(__file__).with_name("picture.png"))
        say(method="progress", params=progress)
        time.sleep(60.0 if seed == IGNORES_CANCEL else 0.02)
        if cancelled.is_set():
            say(id=id, error={"code": -32001, "message": "cancelled"})
            return
    if seed == DIES:
        os._exit(9)
    if seed == NO_MEMORY:
        data = {"kind": "out_of_memory", "remedy": "close other programs"}
        say(id=id, error={"code": -32002, "message": "the machine ran out of memory", "data": data})
        return
    if seed == FAILS:
        data = {"kind": "CheckpointError", "remedy": "choose another checkpoint"}
        say(id=id, error={"code": -32002, "message": "the checkpoint is damaged", "data": data})
        return
    out.mkdir(parents=True, exist_ok=True)
    human = out / "human.npz"
    if seed == GIVES_GARBAGE:
        human.write_bytes(b"PK\x03\x04 no more")
    elif "person" in params:
        write_edited(human, params)
    else:
        shutil.copyfile(os.environ["FAKE_HUMAN"], human)
    (out / "person.human.safetensors").write_bytes(json.dumps(params).encode())
    person = str(out / "person.human.safetensors")
    say(id=id, result={"human": str(human), "person": person, "seed": seed, "steps": steps, "seconds": 0.1})


def write_edited(path: Path, params: dict) -> None:
    """Another colour for primitives 1 and 2, for all where no region is given; another body for a blend."""
    with np.load(os.environ["FAKE_HUMAN"]) as archive:
        arrays = dict(archive)
    arrays["rgb"] = arrays["rgb"].copy()
    region = [1, 2] if "region" in params else slice(None)
    arrays["rgb"][region] = arrays["rgb"][region] * 0.5 + 0.1 * (params["seed"] % 5)
    if "fraction" in params:
        arrays["betas"] = arrays["betas"] + 1
        for name in ("joints", "vertices", "position"):
            arrays[name] = arrays[name] * 1.1
    if "weights" in params:
        with np.load(params["weights"]) as weights:
            arrays["meta"] = np.array(json.dumps({"painted": weights["weights"].tolist()}))
    np.savez(path, **arrays)


def variations(id: int, params: dict, cancelled: threading.Event) -> None:
    """A person of each seed, whose picture is seen after a step; a seed of FAILS or TAKES_LONG among them is obeyed."""
    seeds, out = params["seeds"], Path(params["out_dir"])
    out.mkdir(parents=True, exist_ok=True)
    people = []
    for index, seed in enumerate(seeds):
        picture = out / f"{seed}.png"
        shutil.copyfile(Path(__file__).with_name("picture.png"), picture)
        shown = {"picture": str(picture), "index": index}
        for step in range(100 if seed == TAKES_LONG else 1):
            progress = {"id": id, "stage": "sample", "step": step, "total": params["steps"], "eta_s": 1.0, **shown}
            say(method="progress", params=progress)
            time.sleep(0.02)
            if cancelled.is_set():
                say(id=id, error={"code": -32001, "message": "cancelled"})
                return
        shutil.copyfile(os.environ["FAKE_HUMAN"], out / f"{seed}.human.npz")
        (out / f"{seed}.human.safetensors").write_bytes(json.dumps({**params, "seed": seed}).encode())
        files = {"human": f"{seed}.human.npz", "person": f"{seed}.human.safetensors", "picture": f"{seed}.png"}
        people.append({"seed": seed, **{name: str(out / file) for name, file in files.items()}})
    if FAILS in seeds:
        data = {"kind": "out_of_memory", "remedy": "ask for fewer people"}
        say(id=id, error={"code": -32002, "message": "there is not enough memory", "data": data})
        return
    say(id=id, result={"people": people, "seconds": 0.1})


def reconstruct(id: int, params: dict, cancelled: threading.Event) -> None:
    """Does what is written in the file `order` of the captures; without one it makes the person."""
    order, out = Path(params["capture"]) / "order", Path(params["out_dir"])
    asked = order.read_text() if order.exists() else ""
    for step in range(400 if asked == "take long" else 4):
        say(method="progress", params={"id": id, "stage": "encode", "step": min(step, 3), "total": 4, "eta_s": None})
        time.sleep(0.02)
        if cancelled.is_set():
            say(id=id, error={"code": -32001, "message": "cancelled"})
            return
    if asked == "die":
        os._exit(9)
    if asked == "fail":
        data = {"kind": "bad_input", "remedy": ""}
        say(id=id, error={"code": -32002, "message": "there is no subject 'nobody': choose of anna", "data": data})
        return
    out.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(os.environ["FAKE_HUMAN"], out / "human.npz")
    (out / "person.human.safetensors").write_bytes(json.dumps(params).encode())
    files = {"human": str(out / "human.npz"), "person": str(out / "person.human.safetensors")}
    warnings = ["only one view"] if params["views"] == 1 else []
    say(id=id, result={**files, "warnings": warnings, "seconds": 0.1})


def draw(id: int, params: dict, cancelled: threading.Event) -> None:
    """Fills the frame with COLOUR and DEPTH from the top; takes FAKE_BAND_S a band, fails as FAKE_DRAW says."""
    _, _, width, height = params["region"] or [0, 0, params["width"], params["height"]]
    frame = np.memmap(params["frame"], np.float32, "r+")
    combined = frame[: width * height * 4].reshape(height, width, 4)
    depth = frame[width * height * 4 :].reshape(height, width)
    for band in range(BANDS):
        low, high = height * (BANDS - 1 - band) // BANDS, height * (BANDS - band) // BANDS
        combined[low:high], depth[low:high] = COLOUR, DEPTH
        say(method="progress", params={"id": id, "stage": "draw", "step": height - low, "total": height, "eta_s": 1.0})
        time.sleep(float(os.environ.get("FAKE_BAND_S", "0")))
        if cancelled.is_set():
            say(id=id, error={"code": -32001, "message": "cancelled"})
            return
        if os.environ.get("FAKE_DRAW") == "dies":
            os._exit(9)
        if os.environ.get("FAKE_DRAW") == "no memory":
            data = {"kind": "out_of_memory", "remedy": "draw fewer pixels"}
            say(id=id, error={"code": -32002, "message": "there is not enough memory", "data": data})
            return
    say(id=id, result={"seconds": 0.0, "seconds_place": 0.0, "seconds_march": 0.0})


def edit(id: int, params: dict, cancelled: threading.Event) -> None:
    generate(id, {"seed": 0, **params}, cancelled)


def render(id: int, params: dict, cancelled: threading.Event) -> None:
    """Always the same picture; what was asked for is beside it."""
    out = Path(params["out"])
    shutil.copyfile(Path(__file__).with_name("picture.png"), out)
    Path(os.environ["FAKE_HUMAN"]).with_name("rendered.json").write_text(json.dumps(params))
    say(id=id, result={"out": str(out), "seconds": 0.0})


def human_npz(id: int, params: dict, cancelled: threading.Event) -> None:
    """Whoever is asked for, they are FAKE_HUMAN's."""
    out = Path(params["out_dir"])
    shutil.copyfile(os.environ["FAKE_HUMAN"], out / "human.npz")
    shutil.copyfile(params["person"], out / "person.human.safetensors")
    files = {"human": str(out / "human.npz"), "person": str(out / "person.human.safetensors")}
    say(id=id, result={**files, "seconds": 0.1})


EDITS = dict.fromkeys(("vary", "interpolate", "inpaint", "transfer"), edit)
WORK = {
    **EDITS,
    "generate": generate,
    "human_npz": human_npz,
    "variations": variations,
    "reconstruct": reconstruct,
    "draw": draw,
    "render": render,
}
cancelled = threading.Event()
for line in sys.stdin:
    request = json.loads(line)
    id, method = request["id"], request["method"]
    if method == "hello":
        say(id=id, result={"version": "0-fake", "ready": True, "device": "cpu", "device_name": "fake device"})
    elif method in WORK:
        cancelled.clear()
        threading.Thread(target=WORK[method], args=(id, request["params"], cancelled), daemon=True).start()
    elif method == "cancel":
        cancelled.set()
        say(id=id, result={})
    elif method == "shutdown":
        say(id=id, result={})
        break
