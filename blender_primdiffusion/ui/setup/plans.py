"""What is to be done, as the process that does it is told: everything of Blender's is read here."""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

import bpy

from ...places import CACHE_VARIABLE, backend_module_path, cache_folder, preference, set_up_folder
from ...worker.environment import VARIABLE
from ...worker.setup_steps import Plan
from . import known


def plan_of_set_up(offline: Path | None = None) -> Plan:
    """From the package index, or from a folder of wheels, whose own list of packages goes before ours.

    Raises ValueError where there are no packages for this machine, and OSError.
    """
    compute, lock, _ = known.chosen()
    path = lock.path
    if offline is not None and (offline / known.OWN_LOCK).is_file():
        path = offline / known.OWN_LOCK
    return _plan(lock=str(path), offline=str(offline or ""), compute=compute)


def plan_of_removal() -> Plan:
    """Also where there are no packages for this machine any more. A cache that is shared with others stays."""
    plan = _plan()
    return dataclasses.replace(plan, cache="") if os.environ.get(CACHE_VARIABLE) else plan


def plan_of_test() -> Plan:
    """On the Python that would run the backend."""
    named = preference("backend_python") or os.environ.get(VARIABLE, "")
    return _plan(python=named or (sys.executable if known.known().state == "own Python" else ""))


def _plan(**more: Any) -> Plan:
    return Plan(
        host=sys.executable,
        root=str(set_up_folder().root),
        module_path=str(backend_module_path() or ""),
        cache=str(cache_folder()),
        online=bpy.app.online_access,
        **more,
    )
