"""Answers each method as ANSWERS declares: first the steps with their progress, then what makes the result.

Humans are copies of the file FAKE_HUMAN, their proxies of the files beside it. The child misbehaves if one of the names
in ERRORS and seeds.json is in FAKE_ORDER, or if its seed is asked for. A step takes FAKE_STEP_S seconds.
numpy is imported where arrays change: it takes three times as long as all else, and hundreds of tests start a child.
"""

import importlib.util
import json
import os
import shutil
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

if importlib.util.find_spec("tiny"):  # an environment of tests/contract/tiny_packages.py
    import tiny
    import torch

    PROBLEM, TORCH = tiny.PROBLEM, torch.__version__
else:
    PROBLEM, TORCH = None, "0"

HERE = Path(__file__).parent
PERSON, BODY = "person.human.safetensors", "body.safetensors"
HUMAN = Path(os.environ.get("FAKE_HUMAN", os.devnull))
ORDER, STEP_S = os.environ.get("FAKE_ORDER", ""), float(os.environ.get("FAKE_STEP_S", "0.02"))
ORDERS = {seed: order for order, seed in json.loads((HERE / "seeds.json").read_text()).items()}
ERRORS = {
    "fails": ("the checkpoint is damaged", "CheckpointError", "choose another checkpoint"),
    "no memory": ("the machine ran out of memory", "out_of_memory", "close other programs"),
}
"""Message, kind and remedy."""
GARBAGE = b"PK\x03\x04 no more"
LONG = 100
"""Times as many steps as usual."""
BANDS = 4
COLOUR, DEPTH = (0.25, 0.5, 0.75, 1.0), 3.0
Steps = Iterator[dict]
_lock = threading.Lock()
_cancelled = threading.Event()


def say(**message) -> None:
    with _lock:
        print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)


def say_error(id: int, message: str, kind: str, remedy: str = "") -> None:
    say(id=id, error={"code": -32002, "message": message, "data": {"kind": kind, "remedy": remedy}})


def order_of(params: dict) -> str:
    seeds = params.get("seeds", [params.get("seed")])
    return ORDER or next((ORDERS[seed] for seed in seeds if seed in ORDERS), "")


def steps(stage: str, count: Callable[[dict], int], eta_s: float | None = None) -> Callable[[dict], Steps]:
    """Steps that do nothing; those of generate show a picture if one is asked for."""

    def run(params: dict) -> Steps:
        total = count(params)
        shown = {"picture": str(HERE / "picture.png")} if params.get("picture_px") else {}
        for step in range(total * (LONG if order_of(params) == "takes long" else 1)):
            yield {"stage": stage, "step": min(step, total), "total": total, "eta_s": eta_s, **shown}

    return run


def sheet_steps(params: dict) -> Steps:
    """A step for each human, which shows its picture."""
    out = Path(params["out_dir"])
    out.mkdir(parents=True, exist_ok=True)
    for index, seed in enumerate(params["seeds"]):
        picture = out / f"{seed}.png"
        shutil.copyfile(HERE / "picture.png", picture)
        for step in range(LONG if ORDERS.get(seed) == "takes long" else 1):
            about = {"stage": "sample", "step": step, "total": params["steps"], "eta_s": 1.0}
            yield {**about, "picture": str(picture), "index": index}


def bands(params: dict) -> Steps:
    """Fills the frame with COLOUR and DEPTH from the top."""
    import numpy as np

    _, _, width, height = params["region"] or [0, 0, params["width"], params["height"]]
    frame = np.memmap(params["frame"], np.float32, "r+")
    combined = frame[: width * height * 4].reshape(height, width, 4)
    depth = frame[width * height * 4 :].reshape(height, width)
    for band in range(BANDS):
        low, high = height * (BANDS - 1 - band) // BANDS, height * (BANDS - band) // BANDS
        combined[low:high], depth[low:high] = COLOUR, DEPTH
        yield {"stage": "draw", "step": height - low, "total": height, "eta_s": 1.0}


def human(params: dict) -> dict:
    """The prepared human, or an edit of it; its file says what was asked for."""
    out = Path(params["out_dir"])
    out.mkdir(parents=True, exist_ok=True)
    person = write_person(out / PERSON, params)
    warnings = ["only one view"] if params.get("views") == 1 else []
    warnings += ["the human does not show hat"] if "hat" in params.get("attributes", {}) else []
    return {"person": str(person), "seed": params.get("seed"), "steps": params.get("steps"), "warnings": warnings}


def write_person(path: Path, params: dict) -> Path:
    """Another colour for primitives 1 and 2, for all where no region is given; another shape for a blend."""
    if order_of(params) == "gives garbage":
        path.write_bytes(GARBAGE)
        return path
    if not HUMAN.is_file():
        shutil.copyfile(HUMAN, path)
        return path
    shutil.copyfile(HUMAN.with_name(BODY), path.with_name(BODY))
    content = HUMAN.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    header, data = json.loads(content[8:start]), bytearray(content[start:])
    metadata = header["__metadata__"]
    if "person" in params:
        count, colour = header["rgb"]["shape"][0], 0.1 * (params.get("seed", 0) % 5)
        change(data, header["rgb"], count, (1, 2) if "region" in params else range(count), 0.5, colour)
        edits = [{"edit": "fake", "seed": params.get("seed")}]
        metadata["provenance"] = json.dumps({**json.loads(metadata["provenance"]), "edits": edits})
    if "fraction" in params:
        change(data, header["betas"], 1, (0,), 1.0, 1.0)
    if "weights" in params:
        import numpy as np

        with np.load(params["weights"]) as weights:
            metadata["provenance"] = json.dumps({"painted": weights["weights"].tolist()})
    metadata["asked"] = json.dumps(params)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)
    return path


def change(data: bytearray, about: dict, count: int, parts: Iterable[int], factor: float, more: float) -> None:
    """Multiply a tensor of float32 and add to it, in some of `count` equal parts."""
    begin, end = about["data_offsets"]
    values = array("f", data[begin:end])
    size = len(values) // count
    for part in parts:
        each = values[part * size : (part + 1) * size]
        values[part * size : (part + 1) * size] = array("f", (factor * value + more for value in each))
    data[begin:end] = values.tobytes()


def sheet(params: dict) -> dict:
    people = []
    for seed in params["seeds"]:
        files = {
            name: Path(params["out_dir"]) / f"{seed}{end}" for name, end in (("person", ".human"), ("picture", ".png"))
        }
        write_person(files["person"], {**params, "seed": seed})
        people.append({"seed": seed, **{name: str(path) for name, path in files.items()}})
    return {"people": people}


def posture(params: dict) -> dict:
    """What was given, or a T pose, with the left arm down, the pelvis moved, and a lens a tenth longer."""
    path = Path(params["out_dir"]) / "posture.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    count = len(params["pictures"])
    if "pose" in params and count == 1:
        found = json.loads(Path(params["pose"]).read_text())
    else:
        view = {
            "K": [[80.0, 0, 30], [0, 80.0, 40], [0, 0, 1]],
            "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
            "T": [0, 1, 4],
        }
        cameras = {"camera0000": view}
        if "cameras" in params:
            cameras = json.loads(Path(params["cameras"]).read_text())
        found = {
            "pose": [[0.0] * 72 for _ in range(count)],
            "translation": [[0.0] * 3],
            "betas": [0.0] * 10,
            "cameras": cameras,
        }
    if count > 1 and "pose" in params:
        import numpy as np

        with np.load(params["pose"]) as poses:
            found["pose"] = poses["poses"].tolist()
    found["pose"][0][3 * 16 + 2] -= 0.5
    found["translation"][0][0] += 0.25
    found["betas"][1] += 0.5
    for row in (0, 1):
        found["cameras"]["camera0000"]["K"][row][row] *= 1.1
    path.write_text(json.dumps(found))
    path.with_name("asked.json").write_text(json.dumps(params))
    return {"posture": str(path), "fit": 92, "warnings": ["a guess"]}


def reconstructed(params: dict) -> dict:
    """Backs differ in colour."""
    made = human(params) | (posture(params) if "pictures" in params else {})
    backs = sheet({**params, "person": "", "seeds": list(range(params.get("backs", 0)))})["people"]
    for back in backs:
        shutil.copyfile(HERE / "picture.png", back["picture"])
    return {**made, "backs": backs}


def picture(params: dict) -> dict:
    """Always the same; what was asked for is beside FAKE_HUMAN."""
    shutil.copyfile(HERE / "picture.png", params["out"])
    HUMAN.with_name("rendered.json").write_text(json.dumps(params))
    return {"out": params["out"]}


def merged(params: dict) -> dict:
    files = [Path(params["out_dir"]) / f"{index:04d}.npz" for index in range(len(params["people"]))]
    for path, person in zip(files, params["people"], strict=True):
        write_grid(path, person, params)
    return {"files": [str(path) for path in files]}


def write_grid(path: Path, person: dict, params: dict) -> None:
    """A small grid whose density tells how wide the left arm is raised, at the human's place."""
    import numpy as np

    density = np.zeros((8, 6, 10), np.float16)
    density[2:6, 2:4, 2:8] = 10 + 10 * abs(np.array(person["joints"])[16, 0, 1])
    origin = np.array([row[3] for row in person["object"]])
    unfinished = path.with_suffix(".part")
    with unfinished.open("wb") as file:
        if order_of(params) == "gives garbage":
            file.write(GARBAGE)
        else:
            colour = np.full((*density.shape, 3), 0.5, np.float16)
            np.savez(file, density=density, colour=colour, origin=origin, voxel=np.float64(params["voxel"]))
    os.replace(unfinished, path)


def proxy(params: dict) -> dict:
    out = Path(params["out_dir"])
    out.mkdir(parents=True)
    for name in ("proxy.npz", "proxy.png"):
        shutil.copyfile(HUMAN.with_name(name), out / name)
    files = {"proxy": str(out / "proxy.npz"), "texture": str(out / "proxy.png")}
    return {**files, "triangles": params["triangles"], "betas": params["betas"]}


def gaussians(params: dict) -> dict:
    Path(params["out"]).write_text(json.dumps(params))
    return {"out": params["out"], "gaussians": 7}


def nothing(_params: dict) -> dict:
    return {"seconds_place": 0.0, "seconds_march": 0.0}


at_once = steps("export", lambda _: 0)
edit = (steps("sample", lambda params: params["steps"], 1.0), human)
merging = steps("merge", lambda _: 1)
ANSWERS: dict[str, tuple[Callable[[dict], Steps], Callable[[dict], dict]]] = {
    **dict.fromkeys(("generate", "vary", "interpolate", "inpaint", "transfer"), edit),
    "variations": (sheet_steps, sheet),
    "reconstruct": (steps("encode", lambda _: 4), reconstructed),
    "fit_posture": (steps("fit", lambda _: 4), posture),
    "render": (at_once, picture),
    "draw": (bands, nothing),
    "merge": (merging, merged),
    "proxy": (at_once, proxy),
    "gaussians": (at_once, gaussians),
}


def answer(id: int, method: str, params: dict) -> None:
    if PROBLEM:
        say_error(id, PROBLEM, "environment")
        return
    order = order_of(params)
    run, make = ANSWERS[method]
    for progress in run(params):
        say(method="progress", params={"id": id, **progress})
        time.sleep(60.0 if order == "ignores cancel" else STEP_S)
        if _cancelled.is_set():
            say(id=id, error={"code": -32001, "message": "cancelled"})
            return
    if order == "dies":
        os._exit(9)
    if order in ERRORS:
        say_error(id, *ERRORS[order])
    else:
        say(id=id, result={"seconds": 0.1, **make(params)})


for line in sys.stdin:
    request = json.loads(line)
    id, method = request["id"], request["method"]
    if method == "hello":
        say(id=id, result={"version": "0-fake", "device_name": None})
        if ORDER == "imports slowly":
            time.sleep(LONG * STEP_S)
        about = {"ready": True, "problem": PROBLEM, "torch": TORCH, "device": "cpu", "device_name": "fake device"}
        say(method="ready", params=about)
    elif method in ANSWERS:
        _cancelled.clear()
        threading.Thread(target=answer, args=(id, method, request["params"]), daemon=True).start()
    elif method == "cancel":
        _cancelled.set()
        say(id=id, result={})
    elif method == "shutdown":
        say(id=id, result={})
        break
    else:  # release_memory
        say(id=id, result={})
