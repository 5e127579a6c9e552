"""Sentences with values in them, {} for each: imported where the interface is not English (see `told`)."""

from __future__ import annotations

from . import backend, captures, child, files, jobs, motion, people, render

SENTENCES: tuple[tuple[str, str, str], ...] = (
    *people.SENTENCES, *files.SENTENCES, *motion.SENTENCES, *render.SENTENCES,
    *captures.SENTENCES, *jobs.SENTENCES, *backend.SENTENCES, *child.SENTENCES,
)  # fmt: skip
"""English, German, French."""
