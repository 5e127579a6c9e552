"""How jobs look in panels: button, progress, errors."""

from __future__ import annotations

import textwrap

import bpy

from .session import session

_LINE = 46


def draw_job(layout: bpy.types.UILayout, kind: str, button: str, icon: str) -> None:
    """The button of an operator that makes people by the child's method `kind`; its progress, errors and news."""
    job = session.job
    if job is None or session.kind != kind:
        layout.operator(button, icon=icon)
    else:
        left = f" ({job.eta_s:.0f} s left)" if job.eta_s else ""
        layout.progress(factor=job.fraction, text=f"{job.message}{left}")
        layout.operator("primdiffusion.cancel", icon="CANCEL")
    if session.kind != kind:
        return
    for text, news_icon in ((session.error, "ERROR"), (session.notice, "INFO")):
        for number, line in enumerate(textwrap.wrap(text, _LINE)):
            layout.label(text=line, icon=news_icon if number == 0 else "BLANK1")
