"""Exports of humans: textured meshes, .human files, 3D Gaussians."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..engine.picture import pose_of
from ..files.whole_files import atomic_path
from ..formats.answers import GaussiansAnswer, ProxyAnswer
from ..scene.actions import posed_on
from ..scene.armature import check_joints
from ..scene.human import HumanTarget, link_part, proxy_of, session_file
from ..scene.human_file import (
    read_tensors,
    reshaped,
    shape_model_of,
    write_tensors,
)
from ..scene.proxy import (
    build_proxy,
    read_proxy,
    remove_proxy,
    show_textures_in_solid,
    write_model,
)
from ..scene.representation import MESH_IN_VIEWPORT, set_representation
from ..scene.shape import SAME_BETAS, betas_of, generated_betas, has_custom_shape
from .queue import Job


@dataclasses.dataclass(frozen=True)
class ProxyJob(Job):
    """Base of the jobs that need a mesh proxy."""

    target: HumanTarget
    texture_px: int
    triangles: int

    method = "proxy"

    def params(self, folder: Path) -> dict[str, Any]:
        return {
            "person": self.target.file_now(),
            "out_dir": str(folder / "proxy"),
            "betas": betas_of(self.target.found()).tolist(),
            "texture_px": self.texture_px,
            "triangles": self.triangles,
        }

    def built(self, person: bpy.types.Object, result: ProxyAnswer) -> bpy.types.Object:
        """The proxy as an object, in no collection. Raises ValueError where the human has another shape by now."""
        if not np.allclose(result.betas, betas_of(person), atol=SAME_BETAS):
            raise ValueError(f"the shape of {person.name!r} was changed while its mesh was made: try again")
        return build_proxy(person, read_proxy(result.proxy), result.texture)


@dataclasses.dataclass(frozen=True)
class ExportMeshJob(ProxyJob):
    """Write armature and proxy to a file; the scene stays as it is."""

    kind = "export_mesh"

    path: Path
    format: str
    frames: range
    """One is a pose."""

    @property
    def label(self) -> str:
        return f"Export {self.target.name} to {self.path.name}"

    def finish(self, context: bpy.types.Context, result: ProxyAnswer, _folder: Path) -> str:
        person = self.target.found()
        check_joints(person)
        proxy = self.built(person, result)
        try:
            write_model(context, person, proxy, self.path, self.format, self.frames)
        finally:
            remove_proxy(proxy)
        size = self.path.stat().st_size / 1e6
        frames = f", {len(self.frames)} frames" if len(self.frames) > 1 else ""
        return f"Exported {person.name} to {self.path.name}: {result.triangles} triangles{frames}, {size:.1f} MB"


@dataclasses.dataclass(frozen=True)
class AddProxyJob(ProxyJob):
    """Add the proxy to the human, in place of an earlier one."""

    kind = "add_proxy"
    undo = "Add Mesh Proxy"

    @property
    def label(self) -> str:
        return f"Mesh Proxy of {self.target.name}"

    def finish(self, _context: bpy.types.Context, result: ProxyAnswer, _folder: Path) -> str:
        person = self.target.found()
        earlier = proxy_of(person)
        proxy = self.built(person, result)
        if earlier is not None:
            remove_proxy(earlier)
        link_part(person, proxy)
        set_representation(person, MESH_IN_VIEWPORT)
        show_textures_in_solid()
        return f"Mesh proxy of {result.triangles} triangles for {person.name} in {result.seconds:.1f} s"


def scene_frames(scene: bpy.types.Scene, animated: bool) -> range:
    """The scene's range, or the current frame."""
    if animated:
        return range(scene.frame_start, scene.frame_end + 1)
    return range(scene.frame_current, scene.frame_current + 1)


def posed_frames(context: bpy.types.Context, person: bpy.types.Object, frames: Iterable[int]) -> list[dict[str, Any]]:
    """The human at these frames: file, object matrix, joints and shape, as parameters of the child's `draw`.

    Raises ValueError for an armature in Edit Mode or without SMPL's bones, FileNotFoundError where the file is missing.
    """
    check_joints(person)
    shown = posed_on(context, person, frames)
    return [pose_of(one, np.array(one.matrix_world, np.float64)).params() for one in shown]


def write_human(person: bpy.types.Object, path: Path) -> None:
    """Write the human with its current shape. Raises ValueError or OSError."""
    human = read_tensors(session_file(person))
    if has_custom_shape(person):
        betas = betas_of(person)
        human = reshaped(human, betas, shape_model_of(person).growth(generated_betas(person), betas))
    write_tensors(path, human)


@dataclasses.dataclass(frozen=True)
class ExportGaussiansJob(Job):
    """Write a human in a pose as 3D Gaussians."""

    kind = "export_gaussians"
    method = "gaussians"

    target: HumanTarget
    path: Path
    person: dict[str, Any]
    """The human and its pose, as parameters of `draw`."""
    limit: int

    @property
    def label(self) -> str:
        return f"Export {self.target.name} to {self.path.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        person = {**self.person, "human": self.target.file_now()}
        return {"person": person, "limit": self.limit, "out": str(folder / "gaussians.ply")}

    def finish(self, _context: bpy.types.Context, result: GaussiansAnswer, _folder: Path) -> str:
        put(result.out, self.path)
        size = self.path.stat().st_size / 1e6
        return f"Exported {self.target.name} to {self.path.name}: {result.gaussians} Gaussians, {size:.1f} MB"


def put(source: Path, target: Path) -> None:
    """Copy a finished file to its destination, where it appears whole. Raises OSError."""
    with atomic_path(target) as unfinished:
        shutil.copyfile(source, unfinished)
