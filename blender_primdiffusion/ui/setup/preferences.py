"""Preferences: the backend's state and set-up, which checkpoints it uses, when it gives its memory back."""

from __future__ import annotations

import bpy

from ...places import EXTENSION, set_up_folder
from .drawing import draw_cost, draw_news, draw_progress, draw_text
from .known import gigabytes, known, machine
from .session import redraw, session

_WIDTH = 90
"""Characters in a line of the preferences' window as it opens."""
_COMPUTE = (
    ("AUTOMATIC", "Automatic", "NVIDIA where there is a driver that is new enough, else the processor"),
    ("CPU", "CPU", "Smallest download; a person takes seconds instead of fractions of one"),
    ("CUDA", "NVIDIA (CUDA)", "Large download; needs an NVIDIA card and driver"),
    ("APPLE", "Apple", "For Apple Silicon; computes on its processor"),
)


def _redraw(_preferences: bpy.types.AddonPreferences, _context: bpy.types.Context) -> None:
    """Sidebars are grey, or not, by what is chosen here."""
    redraw()


class PRIMDIFFUSION_AP_preferences(bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > PrimDiffusion."""

    bl_idname = EXTENSION

    compute: bpy.props.EnumProperty(
        name="Compute On", description="For which device packages are installed", items=_COMPUTE
    )
    backend_python: bpy.props.StringProperty(
        name="Existing Python",
        description="Python 3.11 or newer with PrimDiffusion's packages (torch), used instead of the private "
        "environment; empty: the private environment",
        subtype="FILE_PATH",
        update=_redraw,
    )
    checkpoint: bpy.props.StringProperty(
        name="Checkpoint",
        description="A .safetensors file of the diffusion model; empty: the one that comes with the add-on",
        subtype="FILE_PATH",
    )
    encoder: bpy.props.StringProperty(
        name="Encoder",
        description="A .safetensors file of the encoder, for people from captures; empty: the one that comes with "
        "the add-on",
        subtype="FILE_PATH",
    )
    idle_minutes: bpy.props.IntProperty(
        name="Release Memory After",
        description="Minutes after its last job until the backend gives back its memory, also that of the graphics "
        "card; 0: it keeps it",
        default=10,
        min=0,
        soft_max=120,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        """State and set-up first, then file fields. Starts nothing."""
        layout = self.layout
        self._draw_backend(layout.box())
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in ("backend_python", "checkpoint", "encoder", "idle_minutes"):
            layout.prop(self, name)

    def _draw_backend(self, box: bpy.types.UILayout) -> None:
        if session.busy:
            draw_progress(box, _WIDTH)
            return
        now, folder = known(), set_up_folder()
        draw_text(box, now.line, "CHECKMARK" if now.usable else "ERROR", _WIDTH)
        if folder.environment.is_dir():
            size = f"{gigabytes(now.about['bytes'])} in " if "bytes" in now.about else ""
            draw_text(box, f"{size}{folder.environment}", "FILE_FOLDER", _WIDTH)
        if now.state != "named":
            _draw_private(self, box)
        self._draw_buttons(box, now.state, folder.environment.is_dir())
        draw_news(box, _WIDTH)
        if session.error and folder.log.is_file():
            box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(folder.log)

    def _draw_buttons(self, box: bpy.types.UILayout, state: str, private: bool) -> None:
        row = box.row()
        row.operator("primdiffusion.test_backend", icon="PLAY")
        if private or state not in {"absent", "own Python", "named"}:
            row.operator("primdiffusion.repair_backend", icon="TOOL_SETTINGS")
            row.operator("primdiffusion.remove_backend", icon="TRASH")


def _draw_private(preferences: PRIMDIFFUSION_AP_preferences, box: bpy.types.UILayout) -> None:
    """Of the private environment: for what, at which cost, the buttons."""
    row = box.row()
    row.prop(preferences, "compute", expand=True)
    draw_text(box, f"Found: {machine().described}", "SYSTEM", _WIDTH)
    here = draw_cost(box, _WIDTH)
    row = box.row()
    row.enabled = here
    row.operator("primdiffusion.set_up_backend", icon="IMPORT")
    row.operator("primdiffusion.install_from_folder", icon="FILE_FOLDER")
