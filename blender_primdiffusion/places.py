"""Paths and preferences of the extension: its backend, its folders, its caches."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import bpy

from .backend import environment
from .backend.client import PROGRAM, BackendClient
from .backend.requests import Backend

EXTENSION = str(__package__)
"""The extension's full module name; `bl_ext.<repository>.primdiffusion` once installed."""
CACHE_VARIABLE = "PRIMDIFFUSION_CACHE"
"""Environment variable: a folder for caches, which several Blenders may share."""


def backend_module_path() -> Path | None:
    """The folder that holds the package `primdiffusion`: in the zip, or beside us in a checkout, else None."""
    root = Path(__file__).resolve().parent
    for folder in (root / "bundled", root.parent / "backend"):
        if (folder / "primdiffusion" / "__init__.py").is_file():
            return folder
    return None


INSTALLS_BACKEND = (Path(__file__).parent / "backend" / "setup.py").is_file()
"""Whether this build can set up a backend; the viewer build has no code for it (see build_addon.py)."""


def installed_backend() -> Path | None:
    """The program `primdiffusion` that the user has installed, where the extension brings no backend."""
    found = shutil.which(PROGRAM) if backend_module_path() is None else None
    return Path(found) if found else None


def backend_is_named() -> bool:
    """Whether there is a backend to try. The viewer has none until the user has installed one."""
    if backend_module_path() is not None:
        return True
    own = environment.own_python_has_backend(bundled=False)
    try:
        named = environment.candidates(preference("backend_python"), None, installed_backend(), own_python=own)
        return next(named, None) is not None
    except environment.BackendNotFound:
        return True  # a wrong preference: trying says what is wrong


def own_folder() -> Path:
    """The extension's writable folder; a temporary one in a checkout."""
    try:
        return Path(bpy.utils.extension_path_user(EXTENSION, create=True))
    except ValueError:  # not installed as an extension
        return Path(bpy.app.tempdir) / "primdiffusion"


def cache_folder() -> Path | None:
    """Folder for the children's compiled kernels; None in a checkout: beside its sources, where its commands look."""
    if named := os.environ.get(CACHE_VARIABLE, ""):
        return Path(named).absolute()
    return own_folder() / "cache" if EXTENSION.startswith("bl_ext.") else None


def set_up_folder() -> environment.SetUpFolder:
    """Folder of the private environment, with a path short enough for Windows."""
    try:
        own = Path(bpy.utils.extension_path_user(EXTENSION))
    except ValueError:  # not installed as an extension
        own = Path(bpy.utils.user_resource("DATAFILES", path="primdiffusion"))
    local = os.environ.get("LOCALAPPDATA") if os.name == "nt" else None
    root = environment.short_root(own, Path(local) if local else None, "{}{}".format(*bpy.app.version))
    return environment.SetUpFolder(root)


def preference(name: str) -> str:
    """A path from the add-on's preferences, as it is; empty when unset or when the add-on is not enabled.

    It may be relative, to whatever .blend is open: `environment.candidates` and `queue.chosen_checkpoint` reject it.
    """
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return str(getattr(addon.preferences, name, "")).strip() if addon is not None else ""


def shows_captures() -> bool:
    """Whether the preferences ask for the tab of captures; no where the add-on is not enabled."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return addon is not None and bool(getattr(addon.preferences, "captures", False))


def new_backend(python: str) -> Backend:
    """A backend, not yet started, on the interpreter of this path, or for "" on the one found when it starts."""
    module_path, cache = backend_module_path(), cache_folder()
    own_environment = set_up_folder().environment

    def make_client() -> BackendClient:
        _, found = environment.find_python(python or None, own_environment, module_path, installed_backend())
        return BackendClient(found, module_path, cache_dir=cache)

    return Backend(make_client)
