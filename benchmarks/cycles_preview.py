"""Cycles as benchmarks and tests render humans with it: a camera around them, a grey world, one sample."""

from __future__ import annotations

import bpy

from blender_primdiffusion.scene.place import frame_box, humans_extent, new_camera
from blender_primdiffusion.scene.volume_nodes import fit_cycles_to_volumes


def setup_cycles_preview(
    scene: bpy.types.Scene,
    *,
    size: int = 384,
    samples: int = 1,
    yaw: float = 0.0,
    world: float | None = None,
) -> bpy.types.Object:
    """Make `scene` ready to render its humans as they are posed now, and return the camera, which frames them.

    size: pixels a side. samples: per pixel; more samples only smooth edges, since no light scatters. yaw: angle of the
    camera from the front towards the human's left, radians. world: grey level of the background, None for a transparent
    film. The view transform is Standard, so that the picture has the colours of the volumes. A picture of 384 x 384 at
    one sample took a minute on two idle cores (docs/results/demo.json). Raises ValueError for a scene without humans.
    """
    bpy.context.view_layer.update()
    extent = humans_extent(scene)
    scene.render.engine = "CYCLES"
    fit_cycles_to_volumes(scene, samples)
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = world is None
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.world = _flat_world(0.0 if world is None else world)
    scene.camera = new_camera(scene)
    frame_box(scene.camera, extent, yaw)
    return scene.camera


def _flat_world(grey: float) -> bpy.types.World:
    world = bpy.data.worlds.new("PrimDiffusion Preview")
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (grey, grey, grey, 1.0)
    return world
