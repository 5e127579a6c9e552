"""Work of libraries that keep Python to themselves, in a process of its own.

igl and xatlas hold the interpreter's lock for seconds: nobody could cancel meanwhile, and the serving child would look
dead to its parent.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from primdiffusion.worker_process import end_with_parent

GLANCE_S = 0.2


class EndedEarly(RuntimeError):
    """The process died without an answer."""


def apart(function: Callable[..., Any], *arguments: Any, meanwhile: Callable[[], None]) -> Any:
    """What `function`, of a module that is quick to import, returns; arguments and answer are pickled on the way.

    `meanwhile` is called every GLANCE_S; what it raises ends the process at once. Raises what the function does, or
    EndedEarly.
    """
    context = multiprocessing.get_context("spawn")
    answers, answering = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(answering, function, arguments), daemon=True)
    process.start()
    answering.close()
    try:
        while not answers.poll(GLANCE_S):
            meanwhile()
        done, answer = answers.recv()
    except EOFError as e:
        raise EndedEarly(f"{function.__name__} ended without an answer, perhaps for want of memory: try again") from e
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
