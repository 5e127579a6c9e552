"""A child that exports the synthetic person of EXPORT_FOLDER, or fails as EXPORT_FAILS says."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np

STORE = Path(os.environ["EXPORT_FOLDER"])


def say(**message) -> None:
    print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)


def proxy(params: dict) -> dict:
    out = Path(params["out_dir"])
    out.mkdir(parents=True)
    shutil.copyfile(STORE / "proxy.npz", out / "proxy.npz")
    shutil.copyfile(STORE / "proxy.png", out / "proxy.png")
    files = {"proxy": str(out / "proxy.npz"), "texture": str(out / "proxy.png")}
    return {**files, "triangles": params["triangles"], "betas": params["betas"], "seconds": 0.1}


def gaussians(params: dict) -> dict:
    Path(params["out"]).write_text(json.dumps(params))
    return {"out": params["out"], "gaussians": 7, "seconds": 0.1}


def merge_frames(params: dict) -> dict:
    files = []
    for index, person in enumerate(params["people"]):
        density = np.zeros((4, 4, 4), np.float16)
        density[1:3, 1:3, 1:3] = 50
        colour = np.full((4, 4, 4, 3), 0.5, np.float16)
        origin = np.array([row[3] for row in person["object"]])
        path = Path(params["out_dir"]) / f"{index:04d}.npz"
        np.savez(path, density=density, colour=colour, origin=origin, voxel=params["voxel"])
        files.append(str(path))
    return {"files": files, "seconds": 0.1}


def human_npz(params: dict) -> dict:
    out = Path(params["out_dir"])
    shutil.copyfile(STORE / "human.npz", out / "human.npz")
    shutil.copyfile(params["person"], out / "person.human.safetensors")
    return {"human": str(out / "human.npz"), "person": str(out / "person.human.safetensors"), "seconds": 0.1}


WORK = {"proxy": proxy, "gaussians": gaussians, "merge_frames": merge_frames, "human_npz": human_npz}
for line in sys.stdin:
    request = json.loads(line)
    id, method = request["id"], request["method"]
    if method == "hello":
        say(id=id, result={"version": "0-fake", "ready": True, "device": "cpu", "device_name": "fake device"})
    elif method in WORK and os.environ.get("EXPORT_FAILS"):
        data = {"kind": "bad_input", "remedy": ""}
        say(id=id, error={"code": -32002, "message": "the person is too thin: generate them again", "data": data})
    elif method in WORK:
        say(id=id, result=WORK[method](request["params"]))
    elif method == "shutdown":
        say(id=id, result={})
        break
    else:
        say(id=id, result={})
