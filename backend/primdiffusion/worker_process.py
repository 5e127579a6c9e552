"""How a process of a pool starts: with one thread, and never outliving its parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading


def begin_worker() -> None:
    """One thread for torch, which ignores part of the environment; the process ends with its parent.

    A pool's workers would outlive a parent that is killed, and stay on the processors. Ctrl-C is left to the parent,
    which lets workers finish what they are doing.
    """
    import torch  # only in the worker

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
