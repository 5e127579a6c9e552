"""Where the extension finds and keeps things: its own backend, its preferences, its folder for caches."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from collections.abc import Generator

    from .worker.backend import Backend
    from .worker.client import BackendClient
    from .worker.setup import SetUpFolder

EXTENSION = str(__package__)
"""The extension's full module name; `bl_ext.<repository>.primdiffusion` once installed."""
CACHE_VARIABLE = "PRIMDIFFUSION_CACHE"
"""Names another folder than `cache_folder`'s own, for several Blenders to share."""


def backend_module_path() -> Path | None:
    """The folder that holds the package `primdiffusion`: bundled in the zip, or beside us in a checkout, else None."""
    root = Path(__file__).resolve().parent
    for folder in (root / "backend", root.parent / "backend"):
        if (folder / "primdiffusion" / "__init__.py").is_file():
            return folder
    return None


def own_folder() -> Path:
    """A writable folder of the extension's own; a temporary one when it runs from a checkout."""
    try:
        return Path(bpy.utils.extension_path_user(EXTENSION, create=True))
    except ValueError:  # not installed as an extension
        return Path(bpy.app.tempdir) / "primdiffusion"


def cache_folder() -> Path:
    """Where children keep byte code and compiled kernels: our own, or what CACHE_VARIABLE names."""
    named = os.environ.get(CACHE_VARIABLE, "")
    return Path(named).absolute() if named else own_folder() / "cache"


def set_up_folder() -> SetUpFolder:
    """Where the private environment is, or would be: lasting, and short enough for Windows."""
    from .worker import setup

    try:
        own = Path(bpy.utils.extension_path_user(EXTENSION))
    except ValueError:  # not installed as an extension
        own = Path(bpy.utils.user_resource("DATAFILES", path="primdiffusion"))
    local = os.environ.get("LOCALAPPDATA") if os.name == "nt" else None
    root = setup.short_root(own, Path(local) if local else None, "{}{}".format(*bpy.app.version))
    return setup.SetUpFolder(root)


def preference(name: str) -> str:
    """A path from the add-on's preferences, absolute; empty when unset or when the add-on is not enabled."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    value = getattr(addon.preferences, name, "") if addon is not None else ""
    return bpy.path.abspath(value) if value else ""


def new_backend(python: str) -> Backend:
    """A child that is yet to be started, on the interpreter of this path; empty: found when it starts."""
    from .worker import client, environment
    from .worker.backend import Backend

    module_path, cache = backend_module_path(), cache_folder()
    own_environment = set_up_folder().environment

    def make_client() -> Generator[None, None, BackendClient]:
        found = yield from environment.search(python or None, own_environment, module_path, cache_dir=cache)
        made = client.BackendClient(found.path, module_path, cache_dir=cache)
        made.info["torch"] = found.torch  # the child does not report it
        return made

    return Backend(make_client)
