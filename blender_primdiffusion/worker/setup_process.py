"""The process that sets up: a plan comes as its argument, steps go out as lines of JSON, all else into the log.

It heads a group of processes. It ends with all of them when its stdin does: nobody sets up for a Blender that is gone.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from .sentence import sentence
from .setup_folder import SetUpFolder
from .setup_group import end_group, guarded
from .setup_pip import SetUpFailed
from .setup_steps import Plan, Step, remove, repair, self_test, set_up

KINDS: dict[str, Callable[[Plan, IO[str]], Iterator[Step]]] = {
    "set_up": set_up,
    "repair": repair,
    "self_test": lambda plan, _log: self_test(plan),
    "remove": lambda plan, _log: remove(plan),
}


def main() -> None:
    """`setup_process KIND PLAN`: the plan is JSON. Exit code 0: the last line holds a result; 1: an error."""
    kind, plan = sys.argv[1], Plan(**json.loads(sys.argv[2]))
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    sys.exit(_run(kind, plan, plan.folder))


def _run(kind: str, plan: Plan, folder: SetUpFolder) -> int:
    try:
        folder.root.mkdir(parents=True, exist_ok=True)
        with guarded(folder.guard), folder.log.open("w", encoding="utf-8") as log:
            began = time.monotonic()
            try:
                for step in KINDS[kind](plan, log):
                    log.write(f"[{time.monotonic() - began:6.1f} s] {step.message}\n")
                    _say(dataclasses.asdict(step))
            except BaseException:
                log.write(traceback.format_exc())
                raise
    except BlockingIOError:
        return _fail(f"another Blender is setting up the backend in {folder.root}: wait for it")
    except (SetUpFailed, OSError) as error:
        return _fail(str(error))
    except Exception as error:
        return _fail(f"defect: {type(error).__name__}: {error}")
    return 0


def _say(message: dict[str, object]) -> None:
    sys.stdout.buffer.write(json.dumps(message).encode("utf-8") + b"\n")
    sys.stdout.buffer.flush()


def _fail(reason: str) -> int:
    _say({"error": sentence(reason)})
    return 1


def _end_with_parent() -> None:
    while os.read(0, 1):  # not sys.stdin: a thread that waits within it makes the interpreter's end abort
        pass
    end_group(os.getpid())


def command(host: str, kind: str, plan: Plan) -> list[str]:
    """What starts this process with a Python; the extension's folder is never imported as a package of its own."""
    worker_is_in = str(Path(__file__).resolve().parent.parent)
    program = f"import sys; sys.path.insert(0, {worker_is_in!r}); from worker.setup_process import main; main()"
    return [host, "-I", "-B", "-c", program, kind, json.dumps(dataclasses.asdict(plan))]
