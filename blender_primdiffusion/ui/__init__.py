"""What the user sees and presses."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..scene.collect import collect_before_saving
from . import operators, panel, preferences, properties, render_panels
from .generation import session

CLASSES = (
    preferences.PRIMDIFFUSION_AP_preferences,
    properties.PRIMDIFFUSION_PG_settings,
    operators.PRIMDIFFUSION_OT_generate,
    operators.PRIMDIFFUSION_OT_cancel,
    panel.PRIMDIFFUSION_PT_generate,
    render_panels.PRIMDIFFUSION_PT_marching,
    render_panels.PRIMDIFFUSION_PT_film,
    render_panels.PRIMDIFFUSION_PT_passes,
)


@persistent
def drop_job_before_loading(*_: object) -> None:
    """Handler of load_pre: a person asked for in one file must not appear in another."""
    session.close()


def register() -> None:
    """Classes, scene settings and handlers."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion = bpy.props.PointerProperty(type=properties.PRIMDIFFUSION_PG_settings)
    render_panels.join_panels()
    bpy.app.handlers.load_pre.append(drop_job_before_loading)
    bpy.app.handlers.save_pre.append(collect_before_saving)


def unregister() -> None:
    """All of `register` undone, the child ended."""
    session.close()
    if bpy.app.timers.is_registered(operators.follow):
        bpy.app.timers.unregister(operators.follow)
    bpy.app.handlers.save_pre.remove(collect_before_saving)
    bpy.app.handlers.load_pre.remove(drop_job_before_loading)
    render_panels.leave_panels()
    del bpy.types.Scene.primdiffusion
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
