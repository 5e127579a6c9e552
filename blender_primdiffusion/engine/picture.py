"""What is in the picture, whoever looks: people, solids, background and settings, read from a dependency graph."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .people import Posed, posed_people
from .solids import scene_solids, stored


@dataclasses.dataclass(frozen=True)
class Picture:
    """All that the request `draw` wants to know but for the view and the frame."""

    people: tuple[Posed, ...]
    solids: Path | None
    background: tuple[float, float, float] | None
    """Linear; None for a transparent film."""
    shown: str
    """What of the people: "colour", "depth", "alpha" or "boxes"."""
    step: float
    """Metres."""

    @property
    def subject(self) -> NDArray[np.float64]:
        """The middle of the people [3], Blender's world; the origin where nobody is."""
        return np.mean([person.pelvis for person in self.people], 0) if self.people else np.zeros(3)

    def params(self) -> dict[str, Any]:
        """As the request `draw` wants it."""
        return {
            "people": [person.params() for person in self.people],
            "solids": str(self.solids) if self.solids else None,
            "background": list(self.background) if self.background else None,
            "view": self.shown,
            "step": self.step,
        }


def picture_of(
    depsgraph: bpy.types.Depsgraph, solids: Path | None, space: bpy.types.SpaceView3D | None = None
) -> Picture:
    """The scene as the dependency graph, or a viewport, shows it, with `solids_file`'s answer.

    Raises what `posed_people` raises.
    """
    scene = depsgraph.scene
    settings = scene.primdiffusion_render
    return Picture(
        tuple(posed_people(depsgraph, space)),
        solids,
        None if scene.render.film_transparent else world_colour(depsgraph),
        settings.view.lower(),
        settings.step,
    )


def solids_file(
    depsgraph: bpy.types.Depsgraph, folder: Path, space: bpy.types.SpaceView3D | None = None
) -> Path | None:
    """The scene's solid objects as a file in `folder`; None where there are none or where they are to be ignored."""
    wanted = depsgraph.scene.primdiffusion_render.solids
    if wanted == "IGNORED":
        return None
    return stored(scene_solids(depsgraph, wanted == "HOLDOUT", space), folder)


def world_colour(depsgraph: bpy.types.Depsgraph) -> tuple[float, float, float]:
    """The world's plain colour, linear: its Background shader's colour times strength, black without a world.

    Where colour or strength come from other nodes (a sky, a picture), the colour the world has in Solid mode.
    """
    world = getattr(depsgraph.view_layer_eval, "world_override", None) or depsgraph.scene.world
    if world is None:
        return (0.0, 0.0, 0.0)
    if world.node_tree is not None and (bpy.app.version >= (5, 0) or world.use_nodes):
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
