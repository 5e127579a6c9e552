"""The training loop: stopping a run by Ctrl-C."""

from __future__ import annotations

import os
import signal
import threading

from primdiffusion.training.loop import Interrupt


def test_ctrl_c_stops_after_the_step_and_the_handler_is_given_back():
    before = signal.getsignal(signal.SIGINT)
    with Interrupt(None) as interrupt:
        assert not interrupt.due()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        for _ in range(200):
            if interrupt.due():
                break
            threading.Event().wait(0.02)
        assert interrupt.due()
    assert signal.getsignal(signal.SIGINT) is before
