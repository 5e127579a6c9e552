"""What the machine says of itself."""

import os

import numpy as np
import torch
from primdiffusion.machine import best_device, device_info, memory, peak_memory_gb, share_processors


def test_peak_memory_keeps_what_was_given_back():
    before = peak_memory_gb()
    block = np.ones(int((before + 0.2) * 1e9 / 8))
    del block
    assert peak_memory_gb() > before + 0.15


def test_memory_and_device_are_stated_in_gigabytes():
    assert 0.1 < memory()["memory_free_gb"] <= memory()["memory_gb"] < 10_000
    assert device_info(torch.device("cpu"))["device"] == "cpu"
    assert best_device().type in ("cpu", "cuda")


def test_waiting_threads_sleep_unless_the_user_wants_otherwise(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    share_processors()
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    share_processors()
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"
