"""Programs that run in a Blender of their own, with a user folder of its own, and print what they found."""

import json
import os
import subprocess
import sys
from pathlib import Path


def report_of(program: str, *words: object, folder: Path, seconds: float = 500, bare: bool = False, **more: str):
    """What a program beside this file reports in a line of JSON, and its process; `folder` is the current one and gets
    the user folder. `bare`: without the variables of Python and of the extension."""
    (folder / "user").mkdir(exist_ok=True)
    kept = {name: text for name, text in os.environ.items() if not (bare and name.startswith(("PYTHON", "PRIMDIFF")))}
    environment = {**kept, "BLENDER_USER_RESOURCES": str(folder / "user"), **more}
    command = [sys.executable, str(Path(__file__).with_name(program)), *map(str, words)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=seconds, cwd=folder)
    line = next((line for line in done.stdout.splitlines() if line.startswith("REPORT ")), None)
    assert line, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads(line.removeprefix("REPORT ")), done
