"""A child that merges people into small grids whose density tells how wide the left arm is raised, or misbehaves."""

import json
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np

_lock = threading.Lock()
ORDER = os.environ.get("FAKE_MERGE", "")
"""dies, fails, gives garbage, takes long."""


def say(**message) -> None:
    with _lock:
        print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)


def write(path: Path, person: dict, voxel: float) -> None:
    density = np.zeros((8, 6, 10), np.float16)
    density[2:6, 2:4, 2:8] = 10 + 10 * abs(np.array(person["joints"])[16, 0, 1])
    unfinished = path.with_suffix(".part")
    with unfinished.open("wb") as file:
        if ORDER == "gives garbage":
            file.write(b"PK\x03\x04 no more")
        else:
            colour = np.full((*density.shape, 3), 0.5, np.float16)
            np.savez(file, density=density, colour=colour, origin=np.zeros(3), voxel=np.float64(voxel))
    os.replace(unfinished, path)


def merge(params: dict) -> dict:
    write(Path(params["out"]), params["people"][0], params["voxel"])
    return {"out": params["out"], "shape": [8, 6, 10], "seconds": 0.1}


def merge_frames(params: dict) -> dict:
    for index, person in enumerate(params["people"]):
        write(Path(params["out_dir"]) / f"{index:04d}.npz", person, params["voxel"])
    return {"files": [], "seconds": 0.1}


WORK = {"merge": merge, "merge_frames": merge_frames}
cancelled = threading.Event()


def run(id: int, method: str, params: dict) -> None:
    if ORDER == "dies":
        os._exit(9)
    if ORDER == "fails":
        data = {"kind": "bad_input", "remedy": ""}
        say(id=id, error={"code": -32002, "message": "voxels of 0.1 mm make a large grid", "data": data})
        return
    for _ in range(400 if ORDER == "takes long" else 1):
        say(method="progress", params={"id": id, "stage": "merge", "step": 0, "total": 2, "eta_s": None})
        time.sleep(0.02)
        if cancelled.is_set():
            say(id=id, error={"code": -32001, "message": "cancelled"})
            return
    say(id=id, result=WORK[method](params))


for line in sys.stdin:
    request = json.loads(line)
    id, method = request["id"], request["method"]
    if method == "hello":
        say(id=id, result={"version": "0-fake", "ready": True, "device": "cpu", "device_name": "fake device"})
    elif method in WORK:
        cancelled.clear()
        threading.Thread(target=run, args=(id, method, request["params"]), daemon=True).start()
    elif method == "cancel":
        cancelled.set()
        say(id=id, result={})
    elif method == "shutdown":
        say(id=id, result={})
        break
