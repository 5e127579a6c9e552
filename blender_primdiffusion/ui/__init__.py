"""What the user sees and presses."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..scene.collect import collect_before_saving
from . import (
    attributes,
    capture_command,
    capture_operators,
    capture_panel,
    capture_settings,
    edit_operators,
    edit_painting,
    edit_panel,
    edit_settings,
    operators,
    panel,
    preferences,
    properties,
    reconstruct_operators,
    reconstruct_panel,
    reconstruct_settings,
    render_panels,
    unused_files,
)
from .capture_session import captures
from .generation import session

CLASSES = (
    preferences.PRIMDIFFUSION_AP_preferences,
    attributes.PRIMDIFFUSION_PG_attributes,
    properties.PRIMDIFFUSION_PG_settings,
    operators.PRIMDIFFUSION_OT_generate,
    operators.PRIMDIFFUSION_OT_cancel,
    panel.PRIMDIFFUSION_PT_generate,
    panel.PRIMDIFFUSION_PT_attributes,
    edit_settings.PRIMDIFFUSION_PG_edit,
    *edit_operators.EDITS,
    edit_painting.PRIMDIFFUSION_OT_paint_region,
    edit_painting.PRIMDIFFUSION_OT_finish_painting,
    unused_files.PRIMDIFFUSION_OT_remove_unused_files,
    edit_panel.PRIMDIFFUSION_PT_edit,
    *edit_panel.SUB_PANELS,
    capture_settings.PRIMDIFFUSION_PG_captures,
    capture_operators.PRIMDIFFUSION_OT_render_captures,
    capture_operators.PRIMDIFFUSION_OT_cancel_captures,
    capture_operators.PRIMDIFFUSION_OT_verify_captures,
    capture_operators.PRIMDIFFUSION_OT_preview_rig,
    capture_panel.PRIMDIFFUSION_PT_captures,
    *capture_panel.SUB_PANELS,
    reconstruct_settings.PRIMDIFFUSION_PG_reconstruct,
    reconstruct_operators.PRIMDIFFUSION_OT_human_from_captures,
    reconstruct_panel.PRIMDIFFUSION_PT_human_from_captures,
    render_panels.PRIMDIFFUSION_PT_marching,
    render_panels.PRIMDIFFUSION_PT_film,
    render_panels.PRIMDIFFUSION_PT_passes,
)
_commands: list[object] = []
"""Of Blender's command line, while they are known to it."""


@persistent
def drop_job_before_loading(*_: object) -> None:
    """Handler of load_pre: a person asked for in one file must not appear in another."""
    session.close()


def register() -> None:
    """Classes, scene settings and handlers."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion = bpy.props.PointerProperty(type=properties.PRIMDIFFUSION_PG_settings)
    bpy.types.Scene.primdiffusion_edit = bpy.props.PointerProperty(type=edit_settings.PRIMDIFFUSION_PG_edit)
    bpy.types.Scene.primdiffusion_captures = bpy.props.PointerProperty(type=capture_settings.PRIMDIFFUSION_PG_captures)
    bpy.types.Scene.primdiffusion_reconstruct = bpy.props.PointerProperty(
        type=reconstruct_settings.PRIMDIFFUSION_PG_reconstruct
    )
    _commands.append(capture_command.register())
    render_panels.join_panels()
    bpy.app.handlers.load_pre.append(drop_job_before_loading)
    bpy.app.handlers.save_pre.append(collect_before_saving)


def unregister() -> None:
    """All of `register` undone, the children ended."""
    session.close()
    captures.close()
    for timer in (operators.follow, capture_operators.follow):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    while _commands:
        capture_command.unregister(_commands.pop())
    bpy.app.handlers.save_pre.remove(collect_before_saving)
    bpy.app.handlers.load_pre.remove(drop_job_before_loading)
    render_panels.leave_panels()
    del bpy.types.Scene.primdiffusion_reconstruct
    del bpy.types.Scene.primdiffusion_captures
    del bpy.types.Scene.primdiffusion_edit
    del bpy.types.Scene.primdiffusion
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
