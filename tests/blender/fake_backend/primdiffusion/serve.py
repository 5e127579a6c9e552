"""A child that answers generate with FAKE_HUMAN's file, or misbehaves: see the seeds."""

import json
import os
import shutil
import sys
import threading
import time
from pathlib import Path

DIES, FAILS, GIVES_GARBAGE, TAKES_LONG = 1, 2, 3, 4
_lock = threading.Lock()


def say(**message) -> None:
    with _lock:
        print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)


def generate(id: int, params: dict, cancelled: threading.Event) -> None:
    seed, steps, out = params["seed"], params["steps"], Path(params["out_dir"])
    for step in range(steps * (100 if seed == TAKES_LONG else 1)):
        progress = {"id": id, "stage": "sample", "step": min(step, steps), "total": steps, "eta_s": 1.0}
        say(method="progress", params=progress)
        time.sleep(0.02)
        if cancelled.is_set():
            say(id=id, error={"code": -32001, "message": "cancelled"})
            return
    if seed == DIES:
        os._exit(9)
    if seed == FAILS:
        data = {"kind": "CheckpointError", "remedy": "choose another checkpoint"}
        say(id=id, error={"code": -32002, "message": "the checkpoint is damaged", "data": data})
        return
    out.mkdir(parents=True, exist_ok=True)
    human = out / "human.npz"
    if seed == GIVES_GARBAGE:
        human.write_bytes(b"PK\x03\x04 no more")
    else:
        shutil.copyfile(os.environ["FAKE_HUMAN"], human)
    (out / "person.human.safetensors").write_bytes(b"person")
    person = str(out / "person.human.safetensors")
    say(id=id, result={"human": str(human), "person": person, "seed": seed, "steps": steps, "seconds": 0.1})


cancelled = threading.Event()
for line in sys.stdin:
    request = json.loads(line)
    id, method = request["id"], request["method"]
    if method == "hello":
        say(id=id, result={"version": "0-fake", "ready": True, "device": "cpu", "device_name": "fake device"})
    elif method == "generate":
        cancelled.clear()
        threading.Thread(target=generate, args=(id, request["params"], cancelled), daemon=True).start()
    elif method == "cancel":
        cancelled.set()
        say(id=id, result={})
    elif method == "shutdown":
        say(id=id, result={})
        break
