"""Run a function in a separate process, for libraries that hold the GIL.

igl and xatlas hold it for seconds: calls could not be cancelled, and the serving child would look dead to its parent.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from primdiffusion.worker_process import end_with_parent

POLL_S = 0.2


class ProcessDied(RuntimeError):
    """The process exited without returning a result."""


def run_in_process(function: Callable[..., Any], *arguments: Any, meanwhile: Callable[[], None]) -> Any:
    """Return `function(*arguments)`, computed in a spawned process; arguments and result are pickled.

    The process imports the function's module, so that module should import quickly. `meanwhile` is called every
    POLL_S; an exception it raises kills the process. Raises the function's own exceptions, and ProcessDied.
    """
    context = multiprocessing.get_context("spawn")
    answers, answering = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(answering, function, arguments), daemon=True)
    process.start()
    answering.close()
    try:
        while not answers.poll(POLL_S):
            meanwhile()
        done, answer = answers.recv()
    except EOFError as e:
        raise ProcessDied(f"the process of {function.__name__} died, perhaps out of memory: try again") from e
    finally:
        process.kill()
        process.join()
        answers.close()
    if not done:
        raise answer
    return answer


def _answer(answering: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    end_with_parent()
    try:
        answer = True, function(*arguments)
    except Exception as e:
        answer = False, e
    answering.send(answer)
