"""A scene for pictures: Blender as a module with the extension, people, a tiled floor, a camera."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
from mathutils import Vector

BACKGROUND = (0.32, 0.36, 0.42)
_TILES = ((0.20, 0.22, 0.25, 1.0), (0.25, 0.27, 0.30, 1.0))
_FLOOR_TILES = 64


def empty_file(blend: Path) -> bpy.types.Scene:
    """A saved empty file, with the extension registered and this interpreter as its backend."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    if not hasattr(bpy.types, "PRIMDIFFUSION_OT_generate"):
        import blender_primdiffusion

        blender_primdiffusion.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    scene.render.engine = "PRIMDIFFUSION"
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("World")
    scene.world.color = BACKGROUND
    if scene.world.node_tree is not None:
        background = next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND")
        background.inputs["Color"].default_value = (*BACKGROUND, 1.0)
    return scene


def generate(seed: int, position: tuple[float, float] = (0.0, 0.0)) -> bpy.types.Object:
    """Generate a person at x, y, and select them."""
    before = set(bpy.data.objects)
    bpy.ops.primdiffusion.generate(seed=seed)
    person = next(obj for obj in set(bpy.data.objects) - before if "primdiffusion_human" in obj)
    person.location.xy = position
    bpy.context.view_layer.objects.active = person
    return person


def pose(person: bpy.types.Object, name: str) -> None:
    bpy.context.view_layer.objects.active = person
    library = bpy.context.preferences.filepaths.asset_libraries["PrimDiffusion"]
    with bpy.data.libraries.load(str(Path(library.path) / "poses.blend")) as (_, wanted):
        wanted.actions = [name]
    person.pose.apply_pose_from_action(wanted.actions[0])


def tiled_floor(scene: bpy.types.Scene, tile: float, columns: int = _FLOOR_TILES) -> bpy.types.Object:
    """Tiles of two greys, `tile` metres a side, `columns` of them along x; the pattern repeats every two."""
    corners = [
        ((x - columns / 2) * tile, (y - _FLOOR_TILES / 2) * tile, 0.0)
        for y in range(_FLOOR_TILES + 1)
        for x in range(columns + 1)
    ]
    row = columns + 1
    starts = [y * row + x for y in range(_FLOOR_TILES) for x in range(columns)]
    mesh = bpy.data.meshes.new("Floor")
    mesh.from_pydata(corners, [], [(i, i + 1, i + row + 1, i + row) for i in starts])
    for number, colour in enumerate(_TILES):
        material = bpy.data.materials.new(f"Tile {number}")
        material.diffuse_color = colour
        if material.node_tree is not None:
            principled = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
            principled.inputs["Base Color"].default_value = colour
        mesh.materials.append(material)
    for start, polygon in zip(starts, mesh.polygons, strict=True):
        polygon.material_index = (start // row + start % row) % 2
    floor = bpy.data.objects.new("Floor", mesh)
    scene.collection.objects.link(floor)
    return floor


def look(scene: bpy.types.Scene, position: tuple, at: tuple, lens: float = 50.0) -> bpy.types.Object:
    """A camera at `position`, aimed at `at`."""
    data = bpy.data.cameras.new("Camera")
    data.lens = lens
    camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(camera)
    camera.location = position
    camera.rotation_euler = (Vector(at) - Vector(position)).to_track_quat("-Z", "Y").to_euler()
    scene.camera = camera
    return camera


def render(scene: bpy.types.Scene, path: Path, size: tuple[int, int]) -> Path:
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(path), scene=scene)
    print(f"rendered {path.name}", file=sys.stderr, flush=True)
    return path
