"""Human from Picture, from a picture of a human that the window has drawn itself (see `scenes.py`)."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path

import bpy
import numpy as np
from panels import show
from press import Steps, pose, press, wait
from start import FIRST_SEED, SECOND_SEED, armatures, begin, queue_of, select
from visible_scene import at_rest

_SIZE = (480, 640)
_PLACE, _TURN = (0.6, -4.2, 1.1), (math.radians(86), 0.0, math.radians(8))
"""Of the camera that draws pictures: nearly before the human, and as high as a photographer's."""
_FINGERS_M = 0.1
"""Above the end of the hand's bone."""
_MOST_S = 1500.0


def from_picture(module: str, python: str) -> Steps:
    """One standing human from its picture alone, and one with raised arms from a human posed over the picture."""
    yield from from_a_posed_start(module, python)
    picture = yield from drawn(module, python, FIRST_SEED, "Relaxed")
    yield from from_a_photograph(module, python, picture)
    yield from from_a_standing_start(module, python, picture)


def from_a_standing_start(module: str, python: str, picture: Path) -> Steps:
    yield from chosen(module, python, picture)
    yield "picture_chosen"
    yield from pressed(module, "picture_fitting")
    yield "picture_made"
    if press("primdiffusion.human_from_picture", back=2) != {"FINISHED"}:
        raise RuntimeError("the back was not shown")
    queue_of(module).outcomes.clear()
    yield from at_rest(module)
    yield "picture_another_back"
    bpy.context.view_layer.objects.active.select_set(False)
    press("view3d.view_axis", "EXEC_DEFAULT", type="LEFT")
    yield from at_rest(module)
    yield "picture_from_the_side"


def from_a_photograph(module: str, python: str, picture: Path) -> Steps:
    """A human with lowered arms stands ready to be posed over a picture without alpha; several pictures at once."""
    names = [f"photograph_{number}.jpg" for number in range(3)]
    bpy.context.scene.render.image_settings.file_format = "JPEG"
    for name in names:
        bpy.data.images["Render Result"].save_render(str(picture.with_name(name)))
    yield from chosen(module, python, picture.with_name(names[0]))
    yield "picture_photograph"
    files = [{"name": name} for name in names]
    yield from chosen(module, python, picture.with_name(names[0]), directory=str(picture.parent), files=files)
    yield "picture_several"


def from_a_posed_start(module: str, python: str) -> Steps:
    picture = yield from drawn(module, python, SECOND_SEED, "Waving")
    yield from chosen(module, python, picture)
    folder = import_module(f"{module}.ui.menus").FOLDER
    press("primdiffusion.import_human", filepath=str(min(folder.glob("*.human"))))
    yield from wait(lambda: not queue_of(module).busy and bool(armatures()), _MOST_S)
    (armature,) = armatures()
    armature.location = armature.rotation_euler = (0.0, 0.0, 0.0)
    select(armature)
    pose(armature, "Waving")
    move_over_the_picture(armature)
    armature.rotation_euler.z += math.radians(8)
    bpy.context.scene.primdiffusion_picture.backs = 0
    yield from at_rest(module)
    yield "picture_posed"
    yield from pressed(module, "picture_posed_fitting", only_fit=True)
    yield "picture_fitted"
    yield from pressed(module, "picture_posed_making")
    yield "picture_posed_made"


def move_over_the_picture(armature: bpy.types.Object) -> None:
    """Have a human at the origin stand where the picture's person is, as large, as a user does by eye."""
    camera = bpy.context.scene.camera
    image = camera.data.background_images[0].image
    width, height = image.size
    alpha = np.array(image.pixels).reshape(height, width, 4)[..., 3] > 0.5
    rows, columns = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
    bpy.context.view_layer.update()
    tall = max(bone.tail.z for bone in armature.pose.bones) + _FINGERS_M
    pixel = tall / (rows[-1] - rows[0])
    away = camera.data.lens / camera.data.sensor_width * width * pixel
    across, up = columns.mean() - width / 2, rows[0] - height / 2
    armature.location = (across * pixel, camera.location.y + away, camera.location.z + up * pixel)


def drawn(module: str, python: str, seed: int, name: str) -> Steps:
    """Returns a PNG with alpha of a human in a pose, drawn by the engine."""
    yield from begin(module, python)
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    press("primdiffusion.generate", seed=seed)
    yield from wait(lambda: not queue_of(module).busy, _MOST_S)
    (armature,) = armatures()
    select(armature)
    pose(armature, name)
    scene = bpy.context.scene
    scene.camera.location, scene.camera.rotation_euler = _PLACE, _TURN
    scene.render.engine, scene.render.film_transparent = "PRIMDIFFUSION", True
    scene.render.resolution_x, scene.render.resolution_y = _SIZE
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.color_mode = "RGBA"
    path = Path(bpy.app.tempdir) / f"{name.lower()}.png"
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(path))
    yield 1.0
    return path


def chosen(module: str, python: str, picture: Path, **given: object) -> Steps:
    """The picture as the background of a new camera in Blender's factory scene without its cube."""
    yield from begin(module, python)
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    yield from show("PRIMDIFFUSION_PT_generate", "PRIMDIFFUSION_PT_human_from_picture")
    if press("primdiffusion.choose_picture", filepath=str(picture), **given) != {"FINISHED"}:
        raise RuntimeError("the picture was not taken")
    yield 2.0


def pressed(module: str, name: str, **given: object) -> Steps:
    """Make Human or Fit, photographed while it runs and until the view is at rest."""
    if press("primdiffusion.human_from_picture", **given) == {"CANCELLED"}:
        raise RuntimeError("the button was refused: see the line above")
    yield 4.0
    yield name
    yield from wait(lambda: not queue_of(module).busy, _MOST_S)
    last = queue_of(module).last
    if last is not None and last.sentence:
        print(last.sentence, flush=True)
    yield from at_rest(module)
