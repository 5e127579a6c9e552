"""How a process of a pool begins: alone on its core, and never outliving the process that gives it work."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading


def begin_worker() -> None:
    """One thread for torch, which does not heed all of the environment; no life after the process that gives the work.

    A pool's workers outlive a parent that is killed, and keep its place on the processors. Ctrl-C is the parent's to
    heed: it lets workers finish what they are at.
    """
    import torch

    torch.set_num_threads(1)
    end_with_parent()


def end_with_parent() -> None:
    """What `begin_worker` does for a process without torch."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
