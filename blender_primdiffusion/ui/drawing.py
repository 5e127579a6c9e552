"""What panels have in common: how jobs look (button, progress, queue, errors), and buttons for the manual."""

from __future__ import annotations

import functools
import textwrap
from pathlib import Path

import bpy

from ..files.regular_files import printable
from ..jobs.follow import blocking_activity
from ..jobs.queue import JobOutcome, error_log, queue
from ..jobs.windows import icons
from ..places import EXTENSION, backend_is_named, preference

MAIN = "PrimDiffusion"
"""Tab of the sidebar. Blender puts panels of equally named tabs together, those of all add-ons."""
_LINE = 34
"""Characters that fit a sidebar of default width, beside an icon."""
_PICTURE_SCALE = 8.0
_MINUTES_FROM_S = 90.0
_MANUALS = (("manual", ".html"), ("../docs/manual", ".md"))
"""Where pages may be, from the extension's folder: in an installed zip, in a checkout."""


class SidebarPanel:
    """A panel in the sidebar."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = MAIN
    manual_page = ""
    """Page of the manual that a button in the header opens."""
    manual_section = ""

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        if self.manual_page:
            draw_manual_button(self.layout, self.manual_page, self.manual_section)


class BackendPanel(SidebarPanel):
    """A panel of what only the backend can do: the viewer shows it once the user has installed one."""

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return backend_is_named()


def draw_section(
    layout: bpy.types.UILayout, name: str, *, text: str, page: str = "", section: str = ""
) -> bpy.types.UILayout | None:
    """A part of a panel that is closed at first, with a button for its manual page; None while it is closed."""
    header, body = layout.panel(f"primdiffusion_{name}", default_closed=True)
    header.label(text=text)
    if page:
        draw_manual_button(header, page, section)
    return None if body is None else property_columns(body)


def property_columns(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """Names on the left, values on the right, no dots for keyframes."""
    layout.use_property_split = True
    layout.use_property_decorate = False
    return layout


def row_unless(layout: bpy.types.UILayout, reason: str) -> bpy.types.UILayout:
    """A row for buttons; where there is a reason against them, it is greyed out and the line below says why."""
    row = layout.row(align=True)
    row.enabled = not reason
    if reason:
        draw_lines(layout, reason, "INFO")
    return row


def draw_job(
    layout: bpy.types.UILayout, kind: str, operator_idname: str, icon: str, reason: str = "", *, text: str | None = None
) -> bpy.types.OperatorProperties:
    """The button of an operator that submits jobs of `kind`, the progress of such a job, and how the last one ended.

    The button is greyed out where there is a `reason`; its `text` is the operator's label unless given. Returns its
    properties, for the caller to set.
    """
    row = row_unless(layout, reason)
    # Blender takes no None for the label's own text
    props = row.operator(operator_idname, icon=icon, **({} if text is None else {"text": text}))
    draw_job_state(layout, kind)
    return props


def draw_job_state(layout: bpy.types.UILayout, kind: str) -> None:
    """The progress of a job of this kind, and how the last one ended."""
    if queue.current is not None and queue.current.job.kind == kind:
        if icon := icons.of(queue.request.picture):
            layout.template_icon(icon_value=icon, scale=_PICTURE_SCALE)
        draw_progress(layout)
    if waiting := sum(entry.job.kind == kind for entry in queue.waiting):
        layout.label(text=f"Queued: {waiting}", icon="SORTTIME", translate=False)
    if (outcome := queue.outcomes.get(kind)) is not None:
        _draw_outcome(layout, outcome)


def draw_lines(layout: bpy.types.UILayout, text: str, icon: str, width: int = _LINE) -> None:
    """A sentence on as many lines as it needs."""
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(printable(text), width)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1", translate=False)


def draw_progress(layout: bpy.types.UILayout) -> None:
    """The running job: progress, time left, Cancel."""
    row = layout.row(align=True)
    row.progress(factor=1.0 if queue.ready else queue.request.fraction, text=_progress_text(), translate=False)
    row.operator("primdiffusion.cancel", text="", icon="CANCEL").number = 0


def draw_queue(layout: bpy.types.UILayout) -> None:
    """The running job and the queued ones, each with a button to remove it."""
    if not queue.busy:
        return  # an empty column leaves a gap
    column = layout.column(align=True)
    for entry in queue.queued:
        row = column.row(align=True)
        icon = "PLAY" if entry is queue.current else "SORTTIME"
        row.label(text=entry.job.label, icon=icon, translate=False)
        row.operator("primdiffusion.cancel", text="", icon="X").number = entry.number


def _draw_outcome(layout: bpy.types.UILayout, outcome: JobOutcome) -> None:
    """The message, or the error with its log."""
    if outcome.error is None:
        draw_lines(layout, outcome.notice, "INFO")
        return
    draw_lines(layout, outcome.sentence, "ERROR")
    column = layout.column(align=True)  # side by side the labels would be cut
    checkpoint = preference("checkpoint")
    if outcome.error.kind == "environment" or (checkpoint and checkpoint in outcome.sentence):
        column.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES").module = EXTENSION
    column.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(error_log())


def _progress_text() -> str:
    job = queue.request
    if queue.ready:
        blocker = blocking_activity()
        return f"Done; waiting for {blocker}" if blocker else "Adding it to the scene"
    if not job.eta_s:
        return job.message
    left = f"{job.eta_s:.0f} s" if job.eta_s < _MINUTES_FROM_S else f"{job.eta_s / 60:.0f} min"
    return f"{job.message} ({left} left)"


def draw_manual_button(layout: bpy.types.UILayout, page: str, anchor: str = "") -> None:
    """A question mark that opens a page, for the headers of panels; nothing where the manual is not there."""
    if url := page_url(page, anchor):
        layout.operator("wm.url_open", text="", icon="QUESTION", emboss=False).url = url


@functools.cache
def page_url(page: str, anchor: str = "") -> str:
    """Address of a page, or of a heading on it; empty where there is none."""
    path = page_file(page) or page_file("index")
    return "" if path is None else path.as_uri() + (f"#{anchor}" if anchor else "")


def page_file(page: str) -> Path | None:
    """The file of a page; None where there is none."""
    extension = Path(__file__).resolve().parents[1]
    for folder, ending in _MANUALS:
        path = (extension / folder / f"{page}{ending}").resolve()
        if path.is_file() and path.stem == page:
            return path
    return None
