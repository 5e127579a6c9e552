"""Says hello, is ready, makes an empty file of a person. The package `tiny` must be there."""

import json
import sys
from pathlib import Path

import tiny


def say(**message) -> None:
    print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)


for line in sys.stdin:
    request = json.loads(line)
    id, params = request["id"], request["params"]
    if request["method"] == "hello":
        say(id=id, result={"pid": 0, "device_name": None})
        say(method="ready", params={"ready": True, "problem": tiny.PROBLEM, "device_name": "tiny device"})
    elif request["method"] == "generate" and tiny.PROBLEM:
        say(id=id, error={"code": -32002, "message": tiny.PROBLEM, "data": {"kind": "environment"}})
    elif request["method"] == "generate":
        Path(params["out_dir"]).mkdir(parents=True)
        human = Path(params["out_dir"], "human.npz")
        human.touch()
        say(id=id, result={"human": str(human), "person": "", "seconds": 0.0})
    elif request["method"] == "shutdown":
        break
