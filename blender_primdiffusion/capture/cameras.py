"""Blender's camera objects from the cameras of captures and the other way round; a picture as a camera's background."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..files.regular_files import check_regular
from ..formats.camera_rig import View
from ..formats.poses.rotation import first_improper
from ..scene.convention import points_to_backend, points_to_blender

bpy.utils.expose_bundled_modules()
import OpenImageIO  # noqa: E402  Blender's own, importable only after the line above

_SENSOR_MM = 36.0
_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
NEAR_M, FAR_M = 1e-3, 1e4
NAME = "Picture"
LONG_SIDE_DEGREES = 45.0
"""Field of view along the picture's longer side before it is fitted, as the backend assumes too."""
AWAY_M, HEIGHT_M = 4.0, 0.95
"""Distance of a new camera from the human, and its height."""


def aim(camera: bpy.types.Object, view: View) -> tuple[float, float]:
    """Make a camera object see what `view` does; returns the pixels' aspect (x, y) that the scene must have.

    Raises ValueError for pixels that are not rectangles.
    """
    k, data = view.intrinsics, camera.data
    if abs(k[0, 1]) > 1e-9 * k[0, 0]:
        raise ValueError(f"a camera has skewed pixels ({k[0, 1]:g}): Blender has rectangular ones only")
    aspect = (max(1.0, k[1, 1] / k[0, 0]), max(1.0, k[0, 0] / k[1, 1]))
    tall = aspect[1] / aspect[0]
    data.type, data.sensor_fit, data.sensor_width = "PERSP", "HORIZONTAL", _SENSOR_MM
    data.lens = k[0, 0] * _SENSOR_MM / view.width
    data.shift_x = (view.width / 2 - k[0, 2]) / view.width
    data.shift_y = (k[1, 2] - view.height / 2) * tall / view.width
    data.clip_start, data.clip_end = NEAR_M, FAR_M
    matrix = np.eye(4)
    matrix[:3, :3] = points_to_blender(_FROM_OPENCV @ view.rotation).T
    matrix[:3, 3] = points_to_blender(view.position)
    camera.matrix_world = Matrix(matrix.tolist())
    return aspect


def view_of(
    camera: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    size: tuple[int, int],
    aspect: tuple[float, float] = (1.0, 1.0),
) -> View:
    """What a camera object of the user's sees in pictures of `size` (width, height), by Blender's own projection.

    Raises ValueError for cameras without perspective, and for mirrored and sheared ones.
    """
    evaluated = camera.evaluated_get(depsgraph)
    if evaluated.type != "CAMERA" or evaluated.data.type != "PERSP":
        raise ValueError(f"{camera.name!r} is not a perspective camera: choose others, or change its lens type")
    width, height = size
    projection = camera.calc_matrix_camera(depsgraph, x=width, y=height, scale_x=aspect[0], scale_y=aspect[1])
    intrinsics = np.array(
        [
            [projection[0][0] * width / 2, 0, (1 - projection[0][2]) * width / 2],
            [0, projection[1][1] * height / 2, (1 + projection[1][2]) * height / 2],
            [0, 0, 1],
        ]
    )
    axes, position = _frame(evaluated)
    if first_improper(axes[None, None]) is not None:
        raise ValueError(
            f"the camera {camera.name!r} is mirrored or sheared by its scale or a parent's: clear these scales (Alt S)"
        )
    rotation = _FROM_OPENCV @ axes.T
    return View(intrinsics, rotation, -rotation @ position, width, height)


def _frame(camera: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit axes as columns [3, 3] and position [3] in the backend's world; a camera's scale is nothing to its lens."""
    world = np.array(camera.matrix_world, np.float64)
    axes = world[:3, :3] / np.linalg.norm(world[:3, :3], axis=0)
    return points_to_backend(axes.T).T, points_to_backend(world[:3, 3])


def add_picture_camera(context: bpy.types.Context, paths: Sequence[Path], place: np.ndarray) -> bpy.types.Object:
    """Add a camera with the pictures as its backgrounds, facing a human at `place` [3] (Blender's axes), and make it
    the scene's, whose render size becomes that of the first picture, which alone is shown.

    Raises ValueError for what is not a picture or is stored turned, and then leaves nothing.
    """
    images: list[bpy.types.Image] = []
    try:
        for path in paths:
            images.append(_picture(path))
    except ValueError:
        bpy.data.batch_remove(images)
        raise
    data = bpy.data.cameras.new(NAME)
    camera = bpy.data.objects.new(NAME, data)
    context.scene.collection.objects.link(camera)
    data.show_background_images = True
    for image in images:
        background = data.background_images.new()
        background.image, background.alpha, background.frame_method = image, 0.6, "FIT"
        background.show_background_image = image == images[0]
    width, height = images[0].size
    across = np.tan(np.radians(LONG_SIDE_DEGREES / 2)) * width / max(width, height)
    data.sensor_fit, data.angle = "HORIZONTAL", 2 * np.arctan(across)  # as `aim`: views keep the frame's size
    camera.rotation_euler = (np.pi / 2, 0, 0)
    camera.location = (place[0], place[1] - AWAY_M, place[2] + HEIGHT_M)
    render = context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    context.scene.camera = camera
    context.view_layer.update()
    return camera


def _picture(path: Path) -> bpy.types.Image:
    if stored_turned(path):
        raise ValueError(
            f"{path.name!r} is stored turned, with a note in its EXIF data that Blender ignores: rotate it in another "
            "program and save it without that note"
        )
    no_picture = f"{str(path)!r} is not a picture that Blender can read: choose a PNG or JPEG"
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError as error:
        raise ValueError(no_picture) from error
    if min(image.size) < 1:
        bpy.data.images.remove(image)
        raise ValueError(no_picture)
    return image


def pictures_of(camera: bpy.types.Object | None) -> list[bpy.types.Image]:
    """The pictures in a camera's background."""
    if camera is None or camera.type != "CAMERA":
        return []
    return [each.image for each in camera.data.background_images if each.source == "IMAGE" and each.image is not None]


def picture_view(context: bpy.types.Context, camera: bpy.types.Object, image: bpy.types.Image) -> View:
    """What the camera sees in the picture. Raises ValueError where its size is not the scene's render size."""
    render, size = context.scene.render, tuple(image.size)
    if (render.resolution_x, render.resolution_y) != size:
        raise ValueError(
            f"the render size is {render.resolution_x} x {render.resolution_y} pixels, the picture's {size[0]} x "
            f"{size[1]}: make them equal in the output properties, or choose the picture again"
        )
    return view_of(camera, context.evaluated_depsgraph_get(), size)


def aim_at_picture(camera: bpy.types.Object, view: View) -> None:
    """Give the camera the view that was fitted."""
    aim(camera, view)
    camera.data.clip_start, camera.data.clip_end = 0.1, 1000.0


def stored_turned(path: Path) -> bool:
    """Whether a picture's EXIF data says that it must be turned or mirrored. Raises as `check_regular`."""
    check_regular(path)
    file = OpenImageIO.ImageInput.open(str(path))
    if file is None:
        OpenImageIO.geterror()  # else it is printed at the end; Blender itself says what is wrong
        return False
    return file.spec().get_int_attribute("Orientation", 1) != 1
