"""Mesh proxies: made by the child, then exported or added to the scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..scene.attachment import attachment_of, set_attachment
from ..scene.export_model import FrameRange, check_ready, write_model
from ..scene.human import armature_of
from ..scene.proxy import build_proxy, follow_shape, proxy_of, read_proxy, remove_proxy
from ..scene.shape import BODY_FILE, betas_of
from .job import Job
from .target import Target


def show(person: bpy.types.Collection, what: str) -> None:
    """Switch to `what` of `settings.SHOWN`. Raises ValueError where there is no proxy; makes no undo step."""
    from ..scene.merged import merged_of
    from ..scene.proxy import proxy_of
    from ..scene.surface import carrier_of, primitives_of

    proxy = proxy_of(person)
    if proxy is None:
        raise ValueError(f"{person.name!r} has no mesh proxy yet: press Add Mesh Proxy")
    set_attachment(person, attachment_of(person))  # the volumes' parts as their mode wants them
    proxy.hide_viewport, proxy.hide_render = what == "VOLUMES", what != "MESH"
    for part in (primitives_of(person), carrier_of(person), merged_of(person)):
        if part is not None:
            part.hide_viewport = part.hide_viewport or what != "VOLUMES"
            part.hide_render = part.hide_render or what == "MESH"


def shown(person: bpy.types.Collection) -> str:
    """Which of `settings.SHOWN` holds now."""
    from ..scene.proxy import proxy_of

    proxy = proxy_of(person)
    if proxy is None or proxy.hide_viewport:
        return "VOLUMES"
    return "VIEWPORT" if proxy.hide_render else "MESH"


@dataclasses.dataclass(frozen=True)
class ProxyJob(Job):
    """What works that need a proxy have in common."""

    target: Target
    texture_px: int
    triangles: int

    method = "proxy"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method; the shape as it is now."""
        return {
            "person": self.target.file_now(),
            "out_dir": str(folder / "proxy"),
            "betas": betas_of(self.target.found()).tolist(),
            "texture_px": self.texture_px,
            "triangles": self.triangles,
        }

    def built(self, person: bpy.types.Collection, result: dict[str, Any]) -> bpy.types.Object:
        """The proxy as an object, in no collection; on the body of now, if the person was reshaped meanwhile."""
        made = np.array(result["betas"], np.float64)
        proxy = build_proxy(person, read_proxy(Path(result["proxy"])), Path(result["texture"]), made)
        if BODY_FILE in person:
            follow_shape(person, proxy, betas_of(person))
        return proxy


@dataclasses.dataclass(frozen=True)
class ExportMeshJob(ProxyJob):
    """Armature and proxy as a file; nothing of it stays in the scene."""

    kind = "export_mesh"

    path: Path
    format: str
    frames: FrameRange

    @property
    def label(self) -> str:
        """For people."""
        return f"Export {self.target.name} to {self.path.name}"

    def finish(self, context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Build, export, remove."""
        person = self.target.found()
        armature = armature_of(person)
        check_ready(armature)
        proxy = self.built(person, result)
        try:
            write_model(context, armature, proxy, self.path, self.format, self.frames)
        finally:
            remove_proxy(proxy)
        size = self.path.stat().st_size / 1e6
        frames = f", {self.frames.last - self.frames.first + 1} frames" if self.frames.animated else ""
        return f"Exported {person.name} to {self.path.name}: {result['triangles']} triangles{frames}, {size:.1f} MB"


@dataclasses.dataclass(frozen=True)
class AddProxyJob(ProxyJob):
    """The proxy as an object of the person, in the place of an earlier one."""

    kind = "add_proxy"
    undo = "Add Mesh Proxy"

    @property
    def label(self) -> str:
        """For people."""
        return f"Mesh Proxy of {self.target.name}"

    def finish(self, _context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Add it, shown in the viewport."""
        person = self.target.found()
        proxy = self.built(person, result)
        earlier = proxy_of(person)
        if earlier is not None:
            remove_proxy(earlier)
        person.objects.link(proxy)
        show(person, "VIEWPORT")
        return f"Mesh proxy of {result['triangles']} triangles for {person.name} in {result['seconds']:.1f} s"


def scene_frames(scene: bpy.types.Scene, animated: bool) -> FrameRange:
    """The scene's range, or the current frame alone."""
    if animated:
        return FrameRange(scene.frame_start, scene.frame_end)
    return FrameRange(scene.frame_current, scene.frame_current)
