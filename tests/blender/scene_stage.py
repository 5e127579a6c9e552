"""Edits of humans in the scene, written and shown at once, and pictures of the scene."""

from pathlib import Path

import bpy
import numpy as np

from blender_primdiffusion.scene.edit import Replaced, replace_person
from blender_primdiffusion.scene.volume_nodes import write_volumes


def replace(collection: bpy.types.Collection, person: Path) -> Replaced:
    done = replace_person(collection, person)
    write_volumes(collection)
    return done


def render(path: Path) -> np.ndarray:
    """The picture [H, W, 4], linear and premultiplied, top row first."""
    scene = bpy.context.scene
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    return np.array(image.pixels[:]).reshape(image.size[1], image.size[0], 4)[::-1]
