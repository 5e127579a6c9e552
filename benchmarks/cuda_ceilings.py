"""Measured limits of a CUDA device: multiply-adds, memory copies, reads from the second-level cache."""

# pyright: reportGeneralTypeIssues=false, reportCallIssue=false
# Triton kernels are Python by syntax only.
from __future__ import annotations

import statistics
from collections.abc import Callable

import torch
import triton
import triton.language as tl

ROUNDS = 512
CHAINS = 8
"""Independent sums per lane, so that no sum waits for another."""
LANES = 1024
RESIDENT_BYTES = 16 << 20
"""Fits three times into the second-level cache of an H200 (about 50 MB)."""
COPIED_BYTES = 4 << 30


def median_ms(call: Callable[[], object], repeats: int = 50, warm_up: int = 5) -> float:
    """Median milliseconds between CUDA events around a call, with the time that the host takes to launch it."""
    for _ in range(warm_up):
        call()
    torch.cuda.synchronize()
    times = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        call()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    return statistics.median(times)


@triton.jit
def _multiply_add(out, rounds, LANES: tl.constexpr):
    lane = tl.program_id(0) * LANES + tl.arange(0, LANES)
    x = lane.to(tl.float32) * 1e-9 + 0.999
    a, b, c, d = x, x + 0.1, x + 0.2, x + 0.3
    e, f, g, h = x + 0.4, x + 0.5, x + 0.6, x + 0.7
    for _ in range(rounds):
        for _ in tl.static_range(8):
            a, b, c, d = a * x + 0.001, b * x + 0.001, c * x + 0.001, d * x + 0.001
            e, f, g, h = e * x + 0.001, f * x + 0.001, g * x + 0.001, h * x + 0.001
    tl.store(out + lane, a + b + c + d + e + f + g + h)


@triton.jit
def _read(source, out, blocks, rounds, LANES: tl.constexpr):
    lane = tl.arange(0, LANES)
    total = tl.zeros((LANES,), tl.float32)
    for i in range(rounds):
        block = (tl.program_id(0) + i * 37) % blocks
        total += tl.load(source + block * LANES + lane, cache_modifier=".cg")
    tl.store(out + tl.program_id(0) * LANES + lane, total)


def operations_per_second() -> float:
    """float32 operations per second; a fused multiply-add counts as two."""
    programs = 64 * torch.cuda.get_device_properties(0).multi_processor_count
    out = torch.empty(programs * LANES, device="cuda")
    ms = median_ms(lambda: _multiply_add[(programs,)](out, ROUNDS, LANES=LANES, num_warps=4), 20)
    return programs * LANES * CHAINS * 8 * ROUNDS * 2 / ms * 1e3


def copied_bytes_per_second() -> float:
    """Bytes read plus bytes written per second by a copy in device memory much larger than the caches."""
    source = torch.rand(COPIED_BYTES // 4, device="cuda")
    target = torch.empty_like(source)
    return 2 * COPIED_BYTES / median_ms(lambda: target.copy_(source), 20) * 1e3


def cached_bytes_per_second() -> float:
    """Bytes per second read from the second-level cache, bypassing the first level."""
    lanes = 4 * LANES
    source = torch.rand(RESIDENT_BYTES // 4, device="cuda")
    blocks = source.numel() // lanes
    programs = 16 * torch.cuda.get_device_properties(0).multi_processor_count
    out = torch.empty(programs * lanes, device="cuda")
    ms = median_ms(lambda: _read[(programs,)](source, out, blocks, ROUNDS, LANES=lanes, num_warps=8), 20)
    return 4 * programs * lanes * ROUNDS / ms * 1e3
