"""What is drawn: humans, solids, background and settings, read from a dependency graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..scene.armature import model_origin
from ..scene.blend_values import stored_numbers
from ..scene.convention import transforms_to_backend
from ..scene.human import BETA_COUNT, BETAS, is_human
from ..scene.payload import session_file
from .solids import scene_solids, stored, visible_instances

SMALLEST_SCALE = 1e-4
"""Animators hide objects by scaling them to zero: below this a human is smaller than the width of a hair."""


@dataclasses.dataclass(frozen=True)
class PosedHuman:
    """A posed human as the child draws it; backend axes, metres."""

    file: Path
    object_to_world: NDArray[np.float64]
    """[3, 4]; the object's space is the body model's (see `human.ORIGIN`)."""
    joints: NDArray[np.float64]
    """Transforms of SMPL's joints from rest to pose, in the same space [24, 3, 4]."""
    betas: list[float] | None
    """The body's shape; None for the file's."""
    pelvis: NDArray[np.float64]
    """Position [3] in Blender's world."""

    def params(self) -> dict[str, object]:
        """Parameters of the child's `draw`."""
        return {
            "human": str(self.file),
            "object": self.object_to_world.tolist(),
            "joints": self.joints.tolist(),
            "betas": self.betas,
        }


@dataclasses.dataclass(frozen=True)
class SceneContent:
    """What the child's `draw` needs of the scene, without view and frame."""

    people: tuple[PosedHuman, ...]
    solids: Path | None
    background: tuple[float, float, float] | None
    """Linear; None for a transparent film."""
    shown: str
    """What is drawn of the humans: "colour", "depth", "alpha" or "boxes"."""
    step: float
    """Between samples along a ray, metres."""

    @property
    def subject(self) -> NDArray[np.float64]:
        """The middle of the humans [3] in Blender's world; the origin where there are none."""
        return np.mean([person.pelvis for person in self.people], 0) if self.people else np.zeros(3)

    def params(self) -> dict[str, Any]:
        """Parameters of the child's `draw`."""
        return {
            "people": [person.params() for person in self.people],
            "solids": str(self.solids) if self.solids else None,
            "background": list(self.background) if self.background else None,
            "view": self.shown,
            "step": self.step,
        }


def scene_content(
    depsgraph: bpy.types.Depsgraph, solids: Path | None, space: bpy.types.SpaceView3D | None = None
) -> SceneContent:
    """The scene as the dependency graph, or a viewport, shows it, with the file from `solids_file`.

    Raises as `posed_humans` does.
    """
    scene = depsgraph.scene
    settings = scene.primdiffusion_render
    return SceneContent(
        tuple(posed_humans(depsgraph, space)),
        solids,
        None if scene.render.film_transparent else world_colour(depsgraph),
        settings.view.lower(),
        settings.step,
    )


def solids_file(depsgraph: bpy.types.Depsgraph, folder: Path) -> Path | None:
    """The scene's solid objects as a file in `folder`; None where there are none or they are ignored."""
    mode = depsgraph.scene.primdiffusion_render.solids
    if mode == "IGNORED":
        return None
    return stored(scene_solids(depsgraph, mode == "HOLDOUT"), folder)


def world_colour(depsgraph: bpy.types.Depsgraph) -> tuple[float, float, float]:
    """The world's plain colour, linear: its Background shader's colour times strength, black without a world.

    Where colour or strength come from other nodes (a sky, a picture), the colour the world has in Solid mode.
    """
    world = getattr(depsgraph.view_layer_eval, "world_override", None) or depsgraph.scene.world
    if world is None:
        return (0.0, 0.0, 0.0)
    if world.node_tree is not None:
        output = world.node_tree.get_output_node("ALL")
        links = output.inputs["Surface"].links if output is not None else ()
        shader = links[0].from_node if links else None
        if shader is None:
            return (0.0, 0.0, 0.0)
        if shader.type == "BACKGROUND" and not any(socket.is_linked for socket in shader.inputs):
            strength = shader.inputs["Strength"].default_value
            red, green, blue = tuple(shader.inputs["Color"].default_value)[:3]
            return (red * strength, green * strength, blue * strength)
    red, green, blue = world.color
    return (red, green, blue)


def posed_humans(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None) -> list[PosedHuman]:
    """All humans whose armature is visible, in a viewport where one is given; instances included.

    An armature represents its human, which is hidden with it and drawn wherever it is instanced, unless scaled to zero.
    Raises FileNotFoundError for a human whose file is missing, and ValueError for a shape that is no list of numbers or
    a pose that holds NaN.
    """
    armatures = human_armatures(visible_instances(depsgraph, space))
    return [pose_of(obj, matrix) for _, obj, matrix in armatures]


def human_armatures(
    instances: Iterable[bpy.types.DepsgraphObjectInstance],
) -> Iterator[tuple[bpy.types.Object, bpy.types.Object, NDArray[np.float64]]]:
    """Of `visible_instances`, those that show a human: the object that shows it (the human, or what instances it), the
    evaluated armature, which is valid until the next one, and its world matrix [4, 4]."""
    for instance in instances:
        obj = instance.object
        if is_human(obj) and all(name in obj.data.bones for name in JOINT_NAMES):
            matrix = np.array(instance.matrix_world, np.float64)
            if not abs(np.linalg.det(matrix[:3, :3])) < SMALLEST_SCALE**3:
                yield (instance.parent or obj).original, obj, matrix


def pose_of(armature: bpy.types.Object, matrix: NDArray) -> PosedHuman:
    """A human as its armature is posed, with the object at `matrix` [4, 4]. Raises as `posed_humans` does."""
    bones = armature.pose.bones
    posed = np.array([bones[name].matrix for name in JOINT_NAMES], np.float64)
    rest = np.array([bones[name].bone.matrix_local for name in JOINT_NAMES], np.float64)
    if not (np.isfinite(posed).all() and np.isfinite(matrix).all()):
        raise ValueError(f"the armature {armature.name!r} holds NaN or infinite numbers: check its pose and drivers")
    origin = np.eye(4)
    origin[:3, 3] = model_origin(armature.data)
    return PosedHuman(
        session_file(armature.original),
        transforms_to_backend(matrix @ origin),
        transforms_to_backend(np.linalg.inv(origin) @ posed @ np.linalg.inv(rest) @ origin),
        _betas(armature),
        (matrix @ posed[0])[:3, 3],
    )


def _betas(armature: bpy.types.Object) -> list[float] | None:
    if BETAS not in armature:
        return None
    betas = stored_numbers(armature, BETAS, BETA_COUNT)
    if betas is None:
        raise ValueError(
            f"the custom property {BETAS!r} of {armature.name!r} is not a list of numbers: "
            "make it a list of ten numbers, or delete it"
        )
    return betas
