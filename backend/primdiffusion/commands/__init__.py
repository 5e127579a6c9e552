"""Requests and subcommands: a function each, `function(request, session, report)`, for the child and the command line.

It gets a record of `formats.requests` or `options`, checked, and returns its answer. Its module, which loads torch, is
imported when the first request runs, so that the child answers `hello`, and the command line --help, at once.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session

FUNCTIONS = {
    "generate": "generate:generate",
    "variations": "generate:variations",
    **dict.fromkeys(("vary", "interpolate", "inpaint", "transfer"), "edit:edit"),
    "reconstruct": "reconstruct:reconstruct",
    "fit_posture": "reconstruct:fit_posture",
    "refine": "reconstruct:refine_human",
    "render": "render:render",
    "draw": "render:draw",
    "export": "export:export",
    "proxy": "export:proxy",
    "gaussians": "export:gaussians",
    "merge": "export:merge",
    "info": "info:info",
    "attributes": "info:attributes",
    "people": "people:people",
    "payloads": "people:payloads",
    "payloads encode": "people:encode",
    "import-released": "import_released:import_released",
}
"""Module and function by method of JSON-RPC and by subcommand."""


def function_of(name: str) -> Callable[..., Any]:
    """Import the function of a method or subcommand."""
    module, _, function = FUNCTIONS[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), function)


def open_session() -> Session:
    """Load torch and choose the device."""
    return import_module(f"{__name__}.session").Session()
