"""Files of people come along when a .blend is saved."""

from __future__ import annotations

from bpy.app.handlers import persistent

from ...scene.human import any_humans


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre; what collects is imported once there is somebody."""
    if any_humans():
        from ...scene import collect

        collect.collect_before_saving(blend_path)
