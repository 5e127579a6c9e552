"""The 3D view in Rendered mode: requests pictures and draws the newest one, without waiting."""

from __future__ import annotations

import itertools
import weakref
from pathlib import Path

import bpy
import gpu
import numpy as np
from gpu_extras.presets import draw_texture_2d

from . import studio
from .picture import SceneContent, scene_content, solids_file
from .refine import Refinement, ShownPicture, ViewRequest
from .solids import changed_by
from .view import view_from_matrices

TICK_S = 1 / 60
STARTING = "Starting the backend (the first picture after an installation compiles the marcher: half a minute)"
_viewports: weakref.WeakSet[Viewport] = weakref.WeakSet()
_numbers = itertools.count()


class Viewport:
    """One region in Rendered mode. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        number = next(_numbers)
        names = [f"view{number}_{turn}" for turn in "01"]
        self._refinement = Refinement(
            lambda params: studio.drawing_child().draw(params),
            lambda turn, width, height: studio.frames.take(names[int(turn)], width, height),
        )
        self._picture: SceneContent | None = None
        self._solids: Path | None = None
        self._known: tuple[str, bool] | None = None
        """The solids setting and whether the view is local, as of the last reading of solids."""
        self._error = ""
        self._texture: tuple[ShownPicture, gpu.types.GPUTexture] | None = None
        _viewports.add(self)
        weakref.finalize(self, _release, self._refinement, names)

    def update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Read the changed scene while the dependency graph may be read."""
        space = context.space_data
        current = (depsgraph.scene.primdiffusion_render.solids, space.local_view is not None)
        try:
            if current != self._known or changed_by(depsgraph):
                self._solids, self._known = solids_file(depsgraph, studio.frames.folder, space), current
            self._picture = scene_content(depsgraph, self._solids, space)
            self._error = ""
        except (ValueError, OSError) as error:
            self._picture, self._error = None, str(error)

    def draw(self, engine: bpy.types.RenderEngine, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Request what the region shows now, and draw the newest picture over all of it."""
        if self._known is not None and self._known[1] != (context.space_data.local_view is not None):
            self.update(context, depsgraph)  # Blender reports no change
        if self._picture is not None:
            self._refinement.want(_view_request(self._picture, context, depsgraph))
            studio.advance()
            self._refinement.advance()
            if not self._refinement.resting:
                follow()
        shown = self._refinement.shown
        if shown is not None:
            self._draw_picture(engine, shown, context, depsgraph)
        engine.update_stats("", self._status())

    @property
    def resting(self) -> bool:
        """Whether no new picture is expected."""
        return self._refinement.resting

    def advance(self) -> bool:
        """Process the child's answers; True when there is something new to draw."""
        return self._refinement.advance()

    def _status(self) -> str:
        """The text in the corner of the region."""
        if error := self._error or self._refinement.error:
            return f"PrimDiffusion: {error}"
        return STARTING if self._refinement.starting else ""

    def _draw_picture(
        self,
        engine: bpy.types.RenderEngine,
        shown: ShownPicture,
        context: bpy.types.Context,
        depsgraph: bpy.types.Depsgraph,
    ) -> None:
        if self._texture is None or self._texture[0] is not shown:
            frame = shown.frame
            pixels = gpu.types.Buffer("FLOAT", len(frame.combined), frame.combined)
            self._texture = shown, gpu.types.GPUTexture((frame.width, frame.height), format="RGBA16F", data=pixels)
        x, y, width, height = 0, 0, context.region.width, context.region.height
        if shown.request.region is not None:
            x, y, width, height = shown.request.region
        gpu.state.blend_set("ALPHA_PREMULT")
        engine.bind_display_space_shader(depsgraph.scene)
        draw_texture_2d(self._texture[1], (x, y), width, height)
        engine.unbind_display_space_shader()
        gpu.state.blend_set("NONE")


def _release(refinement: Refinement, names: list[str]) -> None:
    """Free the resources of a view that left Rendered mode or was closed."""
    refinement.give_up()
    for name in names:
        studio.frames.drop(name)


def _view_request(picture: SceneContent, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> ViewRequest:
    region, around, space = context.region, context.region_data, context.space_data
    size = (region.width, region.height)
    clip = _clip(around, space)
    projection, to_view = np.array(around.window_matrix), np.array(around.view_matrix)
    view = view_from_matrices(projection, to_view, clip, size, picture.subject)
    part = _border(context, depsgraph, size)
    params = picture.params()
    return ViewRequest((repr(params), repr(view.params()), part), params, view, part)


def _clip(around: bpy.types.RegionView3D, space: bpy.types.SpaceView3D) -> tuple[float, float]:
    camera = space.camera
    if around.view_perspective == "CAMERA" and camera is not None and camera.type == "CAMERA":
        return camera.data.clip_start, camera.data.clip_end
    if around.is_perspective:
        return space.clip_start, space.clip_end
    return -space.clip_end / 2, space.clip_end / 2  # as Blender clips its own parallel views


def _border(
    context: bpy.types.Context, depsgraph: bpy.types.Depsgraph, size: tuple[int, int]
) -> tuple[int, int, int, int] | None:
    """The render border of the view or of the camera looked through, in pixels of the region; None without one."""
    around, space, render = context.region_data, context.space_data, depsgraph.scene.render
    if around.view_perspective == "CAMERA":
        if not render.use_border or space.camera is None or space.camera.type != "CAMERA":
            return None
        low, high = _camera_frame(context, depsgraph)
        edges = np.array([[render.border_min_x, render.border_min_y], [render.border_max_x, render.border_max_y]])
        corners = low + edges * (high - low)
    elif space.use_render_border:
        edges = [
            [space.render_border_min_x, space.render_border_min_y],
            [space.render_border_max_x, space.render_border_max_y],
        ]
        corners = np.array(edges) * size
    else:
        return None
    (left, bottom), (right, top) = np.clip(np.round(corners), 0, size).astype(int).tolist()
    if right <= left or top <= bottom:
        return None
    return left, bottom, right - left, top - bottom


def _camera_frame(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [2] of the camera's picture, pixels of the region."""
    region, camera = context.region, context.space_data.camera
    corners = np.array(camera.data.view_frame(scene=depsgraph.scene), np.float64)
    homogeneous = np.concatenate([corners, np.ones((4, 1))], 1)
    clip = homogeneous @ np.array(context.region_data.window_matrix, np.float64).T
    pixels = (clip[:, :2] / clip[:, 3:] + 1) / 2 * [region.width, region.height]
    return pixels.min(0), pixels.max(0)


def follow() -> None:
    """Poll for answers until every viewport rests."""
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)


def stop() -> None:
    """Stop polling."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def _tick() -> float | None:
    studio.advance()
    if any([viewport.advance() for viewport in _viewports]):  # a list: all of them must advance
        _redraw()
    return TICK_S if any(not viewport.resting for viewport in _viewports) else None


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED":
                area.tag_redraw()
