"""Quality in a word: what the sampler does, for those who do not want to know."""

from __future__ import annotations

import bpy

STEPS_AND_SAMPLER = {"DRAFT": (8, "dpmpp_2m"), "STANDARD": (30, "ddim"), "HIGH": (60, "ddim")}
CUSTOM = "CUSTOM"
ITEMS = [
    ("DRAFT", "Draft", "8 steps of DPM-Solver++: quick, softer, and of the same seed now and then another person"),
    ("STANDARD", "Standard", "30 steps of DDIM"),
    ("HIGH", "High", "60 steps of DDIM: twice the time of Standard for a little more detail"),
    (CUSTOM, "Custom", "Steps and sampler as chosen below"),
]


def apply_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Steps and sampler of the chosen quality. The update function of `quality`."""
    if settings.quality != CUSTOM and quality_of(settings) != settings.quality:
        settings.steps, settings.sampler = STEPS_AND_SAMPLER[settings.quality]


def name_quality(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """The quality that steps and sampler amount to. The update function of both."""
    if settings.quality != quality_of(settings):
        settings.quality = quality_of(settings)


def quality_of(settings: bpy.types.PropertyGroup) -> str:
    """CUSTOM where no other has these steps and this sampler."""
    chosen = (settings.steps, settings.sampler)
    return next((name for name, both in STEPS_AND_SAMPLER.items() if both == chosen), CUSTOM)
