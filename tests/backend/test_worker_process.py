"""Functions run in a separate process."""

import math
import os
import time

import pytest
from primdiffusion.worker_process import ProcessDied, run_in_process


def nothing():
    pass


def test_answers_and_errors_come_back():
    assert run_in_process(math.hypot, 3.0, 4.0, on_wait=nothing) == 5.0
    with pytest.raises(ValueError, match="domain"):
        run_in_process(math.sqrt, -1.0, on_wait=nothing)


def test_a_process_that_dies_is_an_error():
    with pytest.raises(ProcessDied, match="_exit"):
        run_in_process(os._exit, 3, on_wait=nothing)


@pytest.mark.timeout(60)
def test_what_is_raised_meanwhile_ends_it_at_once():
    def cancel():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        run_in_process(time.sleep, 3600, on_wait=cancel)
