"""PrimDiffusion for Blender: generate clothed 3D humans as volumes that follow an SMPL armature, and render them.

bpy and numpy only; the generator runs in a child process with a Python of its own (see `backend`).
"""

from __future__ import annotations

import atexit
import importlib.util
from types import ModuleType

_registered: list[ModuleType] = []
"""Packages that are registered, in order."""


def register() -> None:
    """Called by Blender when the extension is enabled.

    Raises, before anything is registered, RuntimeError if the other build (the extension or its viewer) is enabled, and
    ImportError for a Blender whose Python lacks numpy, openvdb or OpenImageIO, as Debian's may; Blender shows both.
    """
    import bpy  # here, so that the backend's client can be imported without bpy

    if (other := _registered_by(bpy.types)) is not None:
        raise RuntimeError(
            f"{other} is enabled and has the same operators: disable it in Preferences > Add-ons, then enable this one"
        )
    bpy.utils.expose_bundled_modules()
    if missing := [name for name in ("numpy", "openvdb", "OpenImageIO") if importlib.util.find_spec(name) is None]:
        raise ImportError(
            f"The Python of this Blender lacks {missing[0]}: install it (on Debian and Ubuntu: sudo apt install "
            "python3-numpy python3-openvdb python3-openimageio), or use Blender from blender.org"
        )
    from . import engine, ui  # which import numpy

    for package in (engine, ui):
        package.register()
        _registered.append(package)
    if not bpy.app.binary_path:
        atexit.register(unregister)


def unregister() -> None:
    """Called by Blender when the extension is disabled, and at its exit; ends the child processes.

    As a Python module, Blender may not call this at exit: hence `atexit`. A second call does nothing.
    In the application `atexit` would be too late: Blender's data are freed before.
    """
    atexit.unregister(unregister)
    while _registered:
        _registered.pop().unregister()


def _registered_by(types: ModuleType) -> str | None:
    """The module of another extension that has registered our classes; `types` is bpy.types."""
    for name in dir(types):
        if name.startswith("PRIMDIFFUSION_"):
            parts = getattr(types, name).__module__.split(".")
            other = ".".join(parts[:3] if parts[0] == "bl_ext" else parts[:1])
            if other != __package__:
                return other
    return None
