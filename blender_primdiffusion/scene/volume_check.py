"""Whether Cycles of this Blender draws volumes: that of Debian's Blender 5.2 leaves them empty.

`python volume_check.py`, or `blender -b --factory-startup --python volume_check.py`, renders a small VDB and prints
PRIMDIFFUSION DRAWN or PRIMDIFFUSION EMPTY.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np

_SIZE = 8


def draws_volumes(folder: Path) -> bool:
    """Render a cube of shining fog before a black world, in an empty file. Raises RuntimeError without Cycles."""
    bpy.utils.expose_bundled_modules()
    import openvdb  # needs the line above

    fog = openvdb.FloatGrid()
    fog.name, fog.gridClass = "density", openvdb.GridClass.FOG_VOLUME
    fog.copyFromArray(np.full((_SIZE,) * 3, 10.0, np.float32))
    fog.transform = openvdb.createLinearTransform((np.eye(4) * [0.25, 0.25, 0.25, 1.0]).tolist())
    openvdb.write(str(folder / "fog.vdb"), grids=[fog])

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    volume = bpy.data.volumes.new("fog")
    volume.filepath = str(folder / "fog.vdb")
    material = bpy.data.materials.new("fog")
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    shader, output = nodes.new("ShaderNodeVolumePrincipled"), nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Emission Strength"].default_value = 10.0
    material.node_tree.links.new(shader.outputs["Volume"], output.inputs["Volume"])
    volume.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("fog", volume))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = (1.0, 1.0, 8.0)
    scene.collection.objects.link(camera)
    scene.camera = camera

    render = scene.render
    render.engine, render.film_transparent = "CYCLES", True
    render.resolution_x = render.resolution_y = 16
    render.resolution_percentage = 100
    if bpy.app.version >= (5, 0):
        scene.cycles.volume_biased = True  # as for humans
    scene.cycles.device, scene.cycles.samples = "CPU", 1
    render.image_settings.file_format = "PNG"
    render.filepath = str(folder / "fog.png")
    bpy.ops.render.render(write_still=True)
    picture = bpy.data.images.load(render.filepath)
    return max(list(picture.pixels)[::4]) > 0.5


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as _folder:
        print("PRIMDIFFUSION", "DRAWN" if draws_volumes(Path(_folder)) else "EMPTY", flush=True)
