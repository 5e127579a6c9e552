"""Triton kernels that list, for each tile of a picture, the boxes seen in it, nearest first.

Bins of BIN x BIN tiles look through all boxes, then tiles through their bin's list. Lists are exactly as long as they
must be: a program counts, takes that many places from a common counter, and writes.
"""

# pyright: reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# Triton's language is Python by its syntax alone.
from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def list_bins(
    order, indices, entries, begin, count, totals, boxes, across,
    BIN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """One bin of one view: all boxes whose tiles meet it, in `order`."""
    view, bin_ = tl.program_id(1), tl.program_id(0)
    column, row = (bin_ % across) * BIN, (bin_ // across) * BIN
    first_box = view.to(tl.int64) * boxes
    found = tl.zeros((), tl.int32)
    for start in range(0, boxes, LANES):
        k, here = _some(order, first_box, start, boxes, LANES)
        found += tl.sum(_meets(indices, first_box, k, here, column, row, BIN).to(tl.int32), 0)
    place = tl.atomic_add(totals + 4, found.to(tl.int64))
    tl.store(begin + view * tl.num_programs(0) + bin_, place)
    tl.store(count + view * tl.num_programs(0) + bin_, found)
    if found > 0:
        for start in range(0, boxes, LANES):
            k, here = _some(order, first_box, start, boxes, LANES)
            here = _meets(indices, first_box, k, here, column, row, BIN)
            rank = tl.cumsum(here.to(tl.int32), 0) - 1
            tl.store(entries + place + rank, k, here)
            place += tl.sum(here.to(tl.int64), 0)


@triton.jit
def list_tiles(
    bin_entries, bin_begin, bin_count, indices, entries, begin, count, totals, boxes, across, bins_across, bins,
    BIN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """One tile of one view: the boxes of its bin that meet it, in the bin's order."""
    view, tile = tl.program_id(1), tl.program_id(0)
    column, row = tile % across, tile // across
    bin_ = view * bins + (row // BIN) * bins_across + column // BIN
    candidates = tl.load(bin_begin + bin_)
    number = tl.load(bin_count + bin_)
    first_box = view.to(tl.int64) * boxes
    found = tl.zeros((), tl.int32)
    for start in range(0, number, LANES):
        k, here = _some(bin_entries, candidates, start, number, LANES)
        found += tl.sum(_meets(indices, first_box, k, here, column, row, 1).to(tl.int32), 0)
    list_ = view * tl.num_programs(0) + tile
    tl.store(count + list_, found)
    if found == 0:
        tl.store(begin + list_, found.to(tl.int64))
    else:
        place = tl.atomic_add(totals + 5, found.to(tl.int64))
        tl.store(begin + list_, place)
        for start in range(0, number, LANES):
            k, here = _some(bin_entries, candidates, start, number, LANES)
            here = _meets(indices, first_box, k, here, column, row, 1)
            rank = tl.cumsum(here.to(tl.int32), 0) - 1
            tl.store(entries + place + rank, k, here)
            place += tl.sum(here.to(tl.int64), 0)


@triton.jit
def _some(entries, begin, start, number, LANES: tl.constexpr):
    """LANES entries of a list, and which of them exist."""
    i = start + tl.arange(0, LANES)
    return tl.load(entries + begin + i, i < number, 0).to(tl.int32), i < number


@triton.jit
def _meets(indices, first_box, k, here, column, row, SIZE: tl.constexpr):
    """Whether boxes touch any of SIZE x SIZE tiles."""
    line = indices + (first_box + k) * 16
    left, right = tl.load(line + 4, here, 0), tl.load(line + 5, here, -1)
    top, bottom = tl.load(line + 6, here, 0), tl.load(line + 7, here, -1)
    across = (left < column + SIZE) & (right >= column)
    return here & across & (top < row + SIZE) & (bottom >= row)
