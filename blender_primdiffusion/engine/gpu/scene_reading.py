"""Which humans a 3D view shows over what Blender draws, read from the scene as the view shows it; and their payloads
on the GPU, uploaded once."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...scene.human import BODY_MARK, PROXY_MARK, human_of
from ...scene.human_file import read_payload
from ...scene.splats import SPLATS_MARK
from ...scene.volume_nodes import VOLUMES_MARK
from ..boxes import Boxes, boxes_of
from ..picture import PosedHuman, human_armatures, pose_of, visible_instances
from ..view import renders_volumes, view_engine
from .march import GpuPayload
from .shaders import cache_until_exit

PAYLOADS_KEPT = 4
"""Payloads kept of humans that are no longer drawn; 4 MB each."""
READING_S = 0.1
"""Time for reading the files of new humans in one go."""
_UNRELATED = (
    bpy.types.Mesh,
    bpy.types.Curve,
    bpy.types.Material,
    bpy.types.NodeTree,
    bpy.types.Light,
    bpy.types.Camera,
)


class GpuHumans:
    """Payloads on the GPU, by file."""

    def __init__(self) -> None:
        self._payloads: dict[Path, GpuPayload] = {}
        """The latest used last."""

    def placed(self, human: PosedHuman) -> tuple[GpuPayload, Boxes]:
        """Payload and boxes of one human. Raises OSError or ValueError for files, as `read_payload` and `boxes_of`."""
        boxes, payload = boxes_of(human), self._payloads.pop(human.file, None)
        if payload is None:
            tensors = read_payload(human.file)
            payload = GpuPayload(tensors.rgb, tensors.density)
        self._payloads[human.file] = payload
        return payload, boxes

    def holds(self, human: PosedHuman) -> bool:
        """Whether the human's payload is on the GPU already."""
        return human.file in self._payloads

    def keep_only(self, drawn: Iterable[PosedHuman]) -> None:
        """Free the payloads of others, but for the latest PAYLOADS_KEPT."""
        files = {human.file for human in drawn}
        others = [file for file in self._payloads if file not in files]
        for file in others[:-PAYLOADS_KEPT]:
            del self._payloads[file]


@cache_until_exit
def gpu_humans() -> GpuHumans:
    """The humans on the GPU."""
    return GpuHumans()


@dataclasses.dataclass(frozen=True)
class ShownHuman:
    """A human whom a 3D view shows."""

    pose: PosedHuman
    placed: tuple[GpuPayload, Boxes]


@dataclasses.dataclass(frozen=True)
class SceneReading:
    """What a 3D view shows besides Blender's objects."""

    humans: dict[object, ShownHuman]
    """Humans by what their pictures depend on."""
    bones: NDArray[np.float64]
    """Ends of the bones that are shown in front [N, 2, 3], Blender's world: of armatures that are posed or edited, and
    of those that the user wants in front."""
    complete: bool
    """False where files had to be read, which took long enough: the next reading continues."""
    error: str
    """Why humans are not drawn, or not all of them."""


@dataclasses.dataclass(frozen=True)
class ViewContent:
    """What a 3D view shows of a scene; views with equal contents have equal readings."""

    layer: int
    """Address of the view layer."""
    local: int
    """Address of the space where its view is local, else 0."""
    by_volumes: bool
    """An engine draws humans by their volumes."""
    types: frozenset[str]
    """"mesh", "volume" and "pointcloud" (splats), as far as the view's Object Types Visibility shows them."""

    @classmethod
    def of(cls, context: bpy.types.Context) -> ViewContent:
        """The content of the context's space."""
        space = context.space_data
        by_volumes = renders_volumes(view_engine(context.scene.render.engine, space.shading.type))
        types = frozenset(
            kind for kind in ("mesh", "volume", "pointcloud") if getattr(space, f"show_object_viewport_{kind}")
        )
        local = space.as_pointer() if space.local_view else 0
        return cls(context.view_layer.as_pointer(), local, by_volumes, types)


class SceneReader:
    """Reads scenes; keeps what it has placed, because the next reading differs in few humans."""

    def __init__(self) -> None:
        self._placed: dict[object, tuple[GpuPayload, Boxes]] = {}

    def read(self, content: ViewContent, depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D) -> SceneReading:
        """What the space shows, whose content this is."""
        humans: dict[object, ShownHuman] = {}
        candidates: list[tuple[bpy.types.Object, PosedHuman | Exception]] = []
        bones, noted = [np.zeros((0, 2, 3))], {kind: set[bpy.types.Object | None]() for kind in content.types}
        errors, complete, end = [""], True, time.monotonic() + READING_S
        for armature, matrix in human_armatures(_noting(visible_instances(depsgraph, space), noted)):
            if armature.show_in_front or armature.original.mode != "OBJECT":
                bones.append(_bones(armature, matrix))
            try:
                candidates.append((armature.original, pose_of(armature, matrix)))
            except (ValueError, OSError) as error:
                candidates.append((armature.original, error))
        for number, (person, pose) in enumerate(candidates, 1):
            shown = {kind for kind, found in noted.items() if person in found}
            if not shown.isdisjoint(("mesh", "pointcloud")) or (content.by_volumes and "volume" in shown):
                continue
            try:
                if isinstance(pose, Exception):
                    raise pose
                key, known = _key(pose), gpu_humans().holds(pose)
                placed = self._placed.get(key) or gpu_humans().placed(pose)
            except (ValueError, OSError) as error:
                if "volume" not in shown:  # Blender's fog shows where the human is
                    errors.append(str(error))
                continue
            humans[key] = ShownHuman(pose, placed)
            if not known and number < len(candidates) and time.monotonic() > end:
                complete = False
                break
        gpu_humans().keep_only(human.pose for human in humans.values())
        self._placed = {key: human.placed for key, human in humans.items()}
        return SceneReading(humans, np.concatenate(bones), complete, errors[-1])


def concerns_humans(changed: bpy.types.ID) -> bool:
    """Editing a scene's other objects should not wait until all instances have been looked through."""
    if isinstance(changed, bpy.types.Object):
        return (
            changed.type in ("ARMATURE", "EMPTY", "VOLUME", "POINTCLOUD")
            or BODY_MARK in changed
            or PROXY_MARK in changed
            or VOLUMES_MARK in changed
        )
    return not isinstance(changed, _UNRELATED)


def _key(pose: PosedHuman) -> object:
    betas = None if pose.betas is None else tuple(pose.betas)
    return pose.file, pose.object_to_world.tobytes(), pose.joints.tobytes(), betas


def _noting(
    instances: Iterable[bpy.types.DepsgraphObjectInstance], noted: dict[str, set[bpy.types.Object | None]]
) -> Iterator[bpy.types.DepsgraphObjectInstance]:
    """The same instances; `noted`, by kind, gets what Blender may draw of humans: volumes, splats, and as "mesh" their
    mesh proxies and body meshes."""
    for instance in instances:
        obj = instance.object
        is_mesh = PROXY_MARK in obj or BODY_MARK in obj
        kind = "mesh" if is_mesh else obj.type.lower() if obj.type == "VOLUME" or SPLATS_MARK in obj else ""
        if kind in noted:
            noted[kind].add(human_of(obj.original))
        yield instance


def _bones(armature: bpy.types.Object, matrix: NDArray) -> NDArray[np.float64]:
    """Ends [N, 2, 3] of the bones that are not hidden, in Blender's world."""
    shown = [bone for bone in armature.pose.bones if not bone.hide]
    ends = np.array([(bone.head, bone.tail) for bone in shown], np.float64).reshape(-1, 2, 3)
    return ends @ matrix[:3, :3].T + matrix[:3, 3]
