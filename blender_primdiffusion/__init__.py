"""PrimDiffusion for Blender: generate clothed 3D humans as volumes that follow an SMPL armature, and render them.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `backend`).
"""

from __future__ import annotations

import atexit

_registered = False


def register() -> None:
    """Called by Blender when the extension is enabled.

    Raises RuntimeError, before anything is registered, if the other build (the extension or its viewer) is enabled.
    """
    global _registered
    # here, so that the backend's client can be imported without bpy
    import bpy

    if (other := _registered_by()) is not None:
        raise RuntimeError(
            f"{other} is enabled and has the same operators: disable it in Preferences > Add-ons, then enable this one"
        )
    from . import engine, ui  # likewise

    engine.register()
    ui.register()
    _registered = True
    if not bpy.app.binary_path:
        atexit.register(unregister)


def unregister() -> None:
    """Called by Blender when the extension is disabled, and at its exit; ends the child processes.

    As a Python module, Blender 4.5 does not call this at exit and hangs while the engine is active: hence `atexit`.
    Newer ones call it too, after `atexit`; a second call does nothing. In the application `atexit` would be too late:
    Blender's data are freed before.
    """
    global _registered
    if not _registered:
        return
    _registered = False
    from . import engine, ui  # as in `register`

    atexit.unregister(unregister)

    ui.unregister()
    engine.unregister()


def _registered_by() -> str | None:
    """The module of another extension that has registered our classes."""
    import bpy

    for name in dir(bpy.types):
        if name.startswith("PRIMDIFFUSION_"):
            parts = getattr(bpy.types, name).__module__.split(".")
            other = ".".join(parts[:3] if parts[0] == "bl_ext" else parts[:1])
            if other != __package__:
                return other
    return None
