"""Humans in the 3D views that this engine does not render, Solid above all, drawn on the viewport's GPU.

Blender calls `draw` for each region that it redraws. A changed view gets a whole picture at once; a timer marches finer
ones in slices when nothing has changed for a while. Nothing is marched otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import blf
import bpy
import numpy as np
from numpy.typing import NDArray

from ..boxes import seen_part
from ..view import camera_frame, region_view
from .composite import ViewLook, draw_picture, keep_bones
from .march import GpuMarch, gpu_marcher
from .refine import GpuRefinement, MarchRequest
from .scene_reading import SceneReader, SceneReading, ViewContent, concerns_humans

TICK_S = 0.02
REGIONS_KEPT = 8
WIREFRAME_OPACITY = 0.5
"""At least: without it, humans would be invisible, since they have no wires."""
_STICK_PX, _JOINT_PX = 2.2, 2.2
"""Width of Blender's sticks and radius of their joints."""


class Overlay:
    """Pictures of all regions. All methods are for Blender's main thread, `draw` for its draw handlers."""

    def __init__(self) -> None:
        self._regions: dict[int, GpuRefinement] = {}
        """Refinements by the region's address; the latest drawn last."""
        self._reader = SceneReader()
        self._readings: dict[ViewContent, SceneReading] = {}
        """Since the scene has changed."""
        self.undrawn = False
        """There are pictures that the windows have not drawn."""
        self._fault = ""
        """Why the GPU can draw nothing."""
        self.error = ""
        """Why humans are not drawn, or not all of them."""

    def scene_changed(self, changed: Iterable[bpy.types.ID] | None = None) -> None:
        """Read the scene again for the next picture, if one of these data (None: any) may concern humans."""
        if changed is None or any(map(concerns_humans, changed)):
            self._readings.clear()

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the humans into the region that Blender draws now."""
        try:
            if not self._fault:
                self._draw(context)
        except RuntimeError as error:
            self._fail(error)
        if self._fault:
            self.error = f"{self._fault}: show the volumes instead (Advanced > Show As > Show Volumes in Viewport)"

    def leave(self, region: bpy.types.Region) -> None:
        """Drop the picture of a region that is drawn otherwise now: it would be refined beside the engine's."""
        self._regions.pop(region.as_pointer(), None)

    def _draw(self, context: bpy.types.Context) -> None:
        reading = self.reading(context)
        self.error = reading.error
        if not reading.humans:
            return
        picture, request = self._picture_of(context.region), _request(context, reading)
        picture.want(request)
        if picture.fresh:
            picture.advance()
        if not (picture.resting and reading.complete):
            follow()
        keep_bones_in_front(context, reading.bones)
        boxes = [human.placed[1] for human in reading.humans.values()]
        draw_picture(picture.shown.picture, _look(context), seen_part(boxes, request.view))

    def _fail(self, error: RuntimeError) -> None:
        """Draw nothing any more."""
        self._fault = str(error)
        self._regions.clear()

    def advance(self) -> bool:
        """Do some work that does not need the window; True when it must be drawn again."""
        news = False
        try:
            for picture in self._regions.values():
                news = (not picture.fresh and picture.advance()) or news
        except RuntimeError as error:
            self._fail(error)
            news = True
        unread = [key for key, reading in self._readings.items() if not reading.complete]
        for key in unread:
            del self._readings[key]
        return news or bool(unread)

    @property
    def resting(self) -> bool:
        """Whether every region shows its finest picture."""
        complete = all(reading.complete for reading in self._readings.values())
        return complete and all(picture.resting for picture in self._regions.values()) and not self.undrawn

    def reading(self, context: bpy.types.Context) -> SceneReading:
        """What the space shows."""
        content = ViewContent.of(context)
        if content not in self._readings:
            depsgraph = context.evaluated_depsgraph_get()
            self._readings[content] = self._reader.read(content, depsgraph, context.space_data)
            self.error = self._readings[content].error
        return self._readings[content]

    def _picture_of(self, region: bpy.types.Region) -> GpuRefinement:
        address = region.as_pointer()
        picture = self._regions.pop(address, None) or GpuRefinement(samples=1)
        self._regions[address] = picture
        while len(self._regions) > REGIONS_KEPT:
            del self._regions[next(iter(self._regions))]
        return picture


overlay = Overlay()


def _request(context: bpy.types.Context, reading: SceneReading) -> MarchRequest:
    """The picture that a region shows. Raises as `gpu_marcher`."""
    humans, step = list(reading.humans.values()), context.scene.primdiffusion_render.step
    view = region_view(context, np.mean([human.pose.pelvis for human in humans], 0))
    key = (tuple(reading.humans), repr(view.params()), step)
    placed, marcher = [human.placed for human in humans], gpu_marcher()
    return MarchRequest(key, view, lambda view, coarseness: marcher.march(placed, view, step * coarseness))


def keep_bones_in_front(context: bpy.types.Context, bones: NDArray) -> None:
    """Let these bones [N, 2, 3], if the view shows bones, stay above the picture that is drawn next."""
    overlays, around, region = context.space_data.overlay, context.region_data, context.region
    if overlays.show_overlays and overlays.show_bones:
        to_window = np.array(around.window_matrix, np.float64) @ np.array(around.view_matrix, np.float64)
        pixel, size = context.preferences.system.pixel_size, (region.width, region.height)
        keep_bones(_in_pixels(bones, to_window, size), size, _STICK_PX * pixel, _JOINT_PX * pixel)


def erase_behind(context: bpy.types.Context, humans: GpuMarch) -> None:
    """Erase Blender's overlays, such as the grid, where they are behind humans that the view shows below them."""
    keep_bones_in_front(context, overlay.reading(context).bones)
    draw_picture(humans, ViewLook(np.array(context.region_data.window_matrix, np.float64), erases=True))


def follow() -> None:
    """March finer pictures until every region shows its finest."""
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)


def stop() -> None:
    """Stop marching finer pictures."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    overlay.undrawn = False


def _tick() -> float | None:
    """Seconds to wait: marching and drawing both block the windows, and between them Blender handles input."""
    if overlay.undrawn:
        overlay.undrawn = False
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()
    elif overlay.advance():
        overlay.undrawn = True
        return 0.0
    return None if overlay.resting else TICK_S


def draw_error(context: bpy.types.Context) -> None:
    """Say in the corner of a 3D view why humans are not drawn in it."""
    if not overlay.error:
        return
    pixel = context.preferences.system.pixel_size
    blf.size(0, 12 * context.preferences.system.ui_scale)
    blf.color(0, 1.0, 0.6, 0.4, 1.0)
    blf.position(0, 20 * pixel, 20 * pixel, 0)
    blf.draw(0, f"PrimDiffusion: {overlay.error}")


def _in_pixels(points: NDArray, matrix: NDArray, size: tuple[int, int]) -> NDArray[np.float64]:
    """Ends of bones [M, 2, 2] in pixels of the region; without those that reach behind the camera."""
    clip = np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1) @ matrix.T
    clip = clip[(clip[..., 3] > 1e-6).all(1)]
    return (clip[..., :2] / clip[..., 3:] + 1) / 2 * size


def _look(context: bpy.types.Context) -> ViewLook:
    around, shading = context.region_data, context.space_data.shading
    opacity, xray = 1.0, False
    if shading.type == "SOLID" and shading.show_xray:
        opacity, xray = shading.xray_alpha, True
    if shading.type == "WIREFRAME" and shading.show_xray_wireframe:
        opacity, xray = max(shading.xray_alpha_wireframe, WIREFRAME_OPACITY), True
    window, space = np.array(around.window_matrix, np.float64), context.space_data
    look = ViewLook(window, opacity, xray)
    camera = space.camera if around.view_perspective == "CAMERA" and space.overlay.show_overlays else None
    if camera is None or camera.type != "CAMERA" or not camera.data.show_passepartout:
        return look
    low, high = camera_frame(context, context.evaluated_depsgraph_get())
    size = np.array([context.region.width, context.region.height])
    return dataclasses.replace(look, frame=(*(low / size), *(high / size)), darkening=camera.data.passepartout_alpha)
