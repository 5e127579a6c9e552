"""The 3D view in Rendered mode, marched on its GPU; where that cannot be, pictures of the child, without waiting."""

from __future__ import annotations

import dataclasses
import itertools
import weakref
from pathlib import Path

import bpy
import gpu
import numpy as np
from gpu_extras.presets import draw_texture_2d

from . import studio
from .gpu.composite import PictureTextures
from .gpu.picture import GpuPicture, GpuScene, GpuSolids
from .gpu.refine import GpuRefinement, MarchRequest
from .gpu.scene_reading import gpu_humans
from .gpu.start import gpu_start
from .picture import SceneContent, scene_content
from .refine import Refinement, ShownPicture, ViewRequest
from .solids import SceneSolids, changed_by, scene_solids, stored
from .view import camera_frame, view_from_matrices

TICK_S = 1 / 60
STARTING = "Starting the backend (the first picture after an installation compiles the marcher: half a minute)"
_viewports: weakref.WeakSet[Viewport] = weakref.WeakSet()
_numbers = itertools.count()


class Viewport:
    """One region in Rendered mode. All methods are for Blender's main thread, `draw` for its drawing."""

    def __init__(self) -> None:
        number = next(_numbers)
        names = [f"view{number}_{turn}" for turn in "01"]
        self._refinement = Refinement(
            lambda params: studio.drawing_child().draw(params),
            lambda turn, width, height: studio.frames.take(names[int(turn)], width, height),
        )
        """The child's pictures, where the GPU cannot march."""
        self._gpu = GpuRefinement()
        self._gpu_scene: tuple[object, GpuScene] | None = None
        """With what it shows, to be compared."""
        self._picture: SceneContent | None = None
        self._solids: SceneSolids | None = None
        self._solids_count = 0
        """How often solids were read."""
        self._solids_file: Path | None = None
        self._gpu_solids: GpuSolids | None = None
        self._known: tuple[str, bool] | None = None
        """The solids setting and whether the view is local, as of the last reading of solids."""
        self.region = 0
        """Address of the region that was drawn last."""
        self._error = ""
        self._no_gpu = self._gpu_fault = ""
        """Why the child draws, now or from now on."""
        self._shown: ShownPicture | None = None
        self._texture: tuple[gpu.types.GPUTexture, tuple[int, int, int, int] | None] | None = None
        """What is drawn, and the part of the region that it fills."""
        _viewports.add(self)
        weakref.finalize(self, _release, self._refinement, names)

    def update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Read the changed scene while the dependency graph may be read."""
        space = context.space_data
        mode = depsgraph.scene.primdiffusion_render.solids
        current = (mode, space.local_view is not None)
        try:
            if current != self._known or changed_by(depsgraph):
                solids = None if mode == "IGNORED" else scene_solids(depsgraph, mode == "HOLDOUT", space)
                self._solids = solids if solids is not None and len(solids.corners) else None
                self._solids_count, self._known = self._solids_count + 1, current
                self._solids_file = self._gpu_solids = None
            self._picture = scene_content(depsgraph, None, space)
            self._error = ""
        except (ValueError, OSError) as error:
            self._picture, self._error = None, str(error)

    def draw(self, engine: bpy.types.RenderEngine, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """March what the region shows now, or request it from the child, and draw the newest picture."""
        self.region = context.region.as_pointer()
        if self._known is not None and self._known[1] != (context.space_data.local_view is not None):
            self.update(context, depsgraph)  # Blender reports no change
        if self._picture is not None:
            try:
                self._march(self._picture, context, depsgraph)
            except (ValueError, OSError, RuntimeError) as error:
                self._no_gpu = str(error)
                if isinstance(error, RuntimeError):
                    self._gpu_fault = self._no_gpu
                self._ask_child(self._picture, context, depsgraph)
            if not self.resting:
                follow()
        if self._texture is not None:
            self._draw_texture(engine, context, depsgraph, *self._texture)
        engine.update_stats("", self._status())

    def picture_above_overlays(self, context: bpy.types.Context) -> PictureTextures | None:
        """The picture to draw again over overlays that are behind humans: Blender's overlays know the depth of its own
        objects alone. None where that cannot be: with a view transform, which handlers lack, and in part of a view."""
        shown, settings = self._gpu.shown, context.scene.view_settings
        colours = (settings.view_transform, settings.look, settings.exposure, settings.gamma)
        if shown is None or self._no_gpu or self._texture[1] is not None or colours != ("Standard", "None", 0, 1):
            return None
        return PictureTextures(self._texture[0], shown.picture.humans.depth)

    @property
    def resting(self) -> bool:
        """Whether no new picture is expected."""
        return self._refinement.resting if self._no_gpu else self._gpu.resting and not gpu_start.working

    def advance(self) -> bool:
        """Process the child's answers; True when there is something new to draw, or to march while drawing."""
        return self._refinement.advance() if self._no_gpu else self._gpu.due and not gpu_start.working

    def _march(self, picture: SceneContent, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """March for a moment. Raises ValueError, OSError or RuntimeError for what the GPU cannot draw."""
        marcher = gpu_start.marcher()
        if fault := self._gpu_fault or gpu_start.fault:
            raise RuntimeError(fault)
        if picture.shown != "colour":
            raise ValueError("the GPU draws colours alone")
        request = _view_request(picture, context, depsgraph)
        scene = self._scene_on_gpu(picture)
        view = request.view if request.region is None else request.view.part(request.region)
        key = (request.key, self._solids_count, request.region)
        begin = None if marcher is None else lambda view: GpuPicture(marcher, scene, view)
        self._gpu.want(MarchRequest(key, view, lambda view: GpuPicture(None, scene, view), begin))
        self._no_gpu, before = "", self._gpu.shown
        if self._gpu.advance() and self._gpu.shown is not before:
            shown = self._gpu.shown
            mean = self._texture[0] if shown.sample else None
            self._texture = shown.picture.compose(mean, shown.sample), shown.request.key[-1]

    def _scene_on_gpu(self, picture: SceneContent) -> GpuScene:
        key = (repr(picture.params()), self._solids_count)
        if self._gpu_scene is None or self._gpu_scene[0] != key:
            if self._solids is not None and self._gpu_solids is None:
                self._gpu_solids = GpuSolids(self._solids)
            humans = [gpu_humans().placed(human) for human in picture.people]
            gpu_humans().keep_only(picture.people)
            self._gpu_scene = key, GpuScene(humans, self._gpu_solids, picture.background, picture.step)
        return self._gpu_scene[1]

    def _ask_child(self, picture: SceneContent, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        if self._solids is not None and self._solids_file is None:
            self._solids_file = stored(self._solids, studio.frames.folder)
        picture = dataclasses.replace(picture, solids=self._solids_file)
        self._refinement.want(_view_request(picture, context, depsgraph))
        studio.advance()
        self._refinement.advance()
        shown = self._refinement.shown
        if shown is not None and shown is not self._shown:
            frame, self._shown = shown.frame, shown
            pixels = gpu.types.Buffer("FLOAT", len(frame.combined), frame.combined)
            texture = gpu.types.GPUTexture((frame.width, frame.height), format="RGBA16F", data=pixels)
            self._texture = texture, shown.request.region

    def _status(self) -> str:
        """The text in the corner of the region."""
        if error := self._error or (self._refinement.error if self._no_gpu else ""):
            return f"PrimDiffusion: {error}"
        return f"{STARTING}; {self._no_gpu}" if self._no_gpu and self._refinement.starting else ""

    def _draw_texture(
        self,
        engine: bpy.types.RenderEngine,
        context: bpy.types.Context,
        depsgraph: bpy.types.Depsgraph,
        texture: gpu.types.GPUTexture,
        part: tuple[int, int, int, int] | None,
    ) -> None:
        x, y, width, height = part or (0, 0, context.region.width, context.region.height)
        gpu.state.blend_set("ALPHA_PREMULT")
        engine.bind_display_space_shader(depsgraph.scene)
        draw_texture_2d(texture, (x, y), width, height)
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
        low, high = camera_frame(context, depsgraph)
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


def picture_above_overlays(context: bpy.types.Context) -> PictureTextures | None:
    """As `Viewport.picture_above_overlays`, for the viewport of this region."""
    address = context.region.as_pointer()
    viewport = next((viewport for viewport in _viewports if viewport.region == address), None)
    return None if viewport is None else viewport.picture_above_overlays(context)


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
    ready = gpu_start.advance()
    if ready or any([viewport.advance() for viewport in _viewports]):  # a list: all of them must advance
        _redraw()
    return TICK_S if any(not viewport.resting for viewport in _viewports) else None


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED":
                area.tag_redraw()
