"""The 3D view in Rendered mode, marched on the GPU that draws it."""

from __future__ import annotations

import functools
import weakref

import bpy
import gpu
import numpy as np
from gpu_extras.presets import draw_texture_2d

from .gpu.composite import PictureTextures
from .gpu.march import gpu_marcher
from .gpu.picture import GpuPicture, GpuScene, GpuSolids
from .gpu.refine import GpuRefinement, MarchRequest
from .gpu.scene_reading import gpu_humans
from .picture import SceneContent, SceneSolids, changed_by, scene_content, scene_solids
from .view import camera_frame, region_view

Region = tuple[int, int, int, int]
"""A part of a window's region [x, y, width, height], pixels from the left and the bottom."""
_viewports: weakref.WeakSet[Viewport] = weakref.WeakSet()


class Viewport:
    """One region in Rendered mode. All methods are for Blender's main thread, `draw` for its drawing."""

    def __init__(self) -> None:
        self._refinement = GpuRefinement()
        self._content: SceneContent | None = None
        self._solids: SceneSolids | GpuSolids | None = None
        """On the GPU once they have been drawn."""
        self._solids_of: tuple[str, bool] | None = None
        """The solids setting and whether the view is local, as of the last reading of solids."""
        self._scene: tuple[str, GpuScene] | None = None
        """With the parameters of the content that it shows; None when the solids have changed."""
        self._texture: tuple[gpu.types.GPUTexture, Region | None] | None = None
        """What is drawn, and the part of the region that it fills."""
        self.region = 0
        """Address of the region that was drawn last."""
        self._error = ""
        """Why the scene cannot be drawn."""
        self._fault = ""
        """Why the GPU cannot draw, which is not tried again."""
        _viewports.add(self)

    def update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Read the changed scene while the dependency graph may be read."""
        space = context.space_data
        mode = depsgraph.scene.primdiffusion_render.solids
        current = (mode, space.local_view is not None)
        try:
            if current != self._solids_of or changed_by(depsgraph):
                solids = None if mode == "IGNORED" else scene_solids(depsgraph, mode == "HOLDOUT", space)
                self._solids = solids if solids is not None and len(solids.corners) else None
                self._solids_of, self._scene = current, None
            self._content = scene_content(depsgraph, None, space)
            self._error = ""
        except (ValueError, OSError) as error:
            self._content, self._error = None, str(error)

    def draw(self, engine: bpy.types.RenderEngine, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """March what the region shows now for a moment, and draw what has come of it."""
        self.region = context.region.as_pointer()
        if self._solids_of is not None and self._solids_of[1] != (context.space_data.local_view is not None):
            self.update(context, depsgraph)  # Blender reports no change
        status = self._error
        if self._fault:
            status = self._fault
        elif self._content is not None:
            try:
                self._march(self._content, context, depsgraph)
                status = _shown_otherwise(depsgraph.scene)
            except (ValueError, OSError) as error:  # until the scene changes
                self._content, self._error = None, str(error)
                status = self._error
            except RuntimeError as error:
                status = self._fault = str(error)
        if not self.resting:
            engine.tag_redraw()
        if self._texture is not None:
            self._draw_texture(engine, context, depsgraph, *self._texture)
        engine.update_stats("", f"PrimDiffusion: {status}" if status else "")

    def picture_above_overlays(self, context: bpy.types.Context) -> PictureTextures | None:
        """The picture to draw again over overlays that are behind humans: Blender's overlays know the depth of its own
        objects alone. None where that cannot be: with a view transform, which handlers lack, and in part of a view."""
        shown, settings = self._refinement.shown, context.scene.view_settings
        colours = (settings.view_transform, settings.look, settings.exposure, settings.gamma)
        if shown is None or self._texture[1] is not None or colours != ("Standard", "None", 0, 1):
            return None
        return PictureTextures(self._texture[0], shown.picture.humans.depth)

    @property
    def resting(self) -> bool:
        """Whether no new picture is expected."""
        return self._content is None or bool(self._fault) or self._refinement.resting

    def _march(self, content: SceneContent, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """March for a moment. Raises ValueError or OSError for a human who cannot be drawn, RuntimeError without a GPU
        that can."""
        marcher, scene, view = gpu_marcher(), self._scene_on_gpu(content), region_view(context, content.subject)
        part = _border(context, depsgraph, (view.width, view.height))
        key = (scene, repr(view.params()), part)
        view = view if part is None else view.part(part)
        self._refinement.want(MarchRequest(key, view, functools.partial(GpuPicture, marcher, scene)))
        if self._refinement.advance():
            shown = self._refinement.shown
            mean = self._texture[0] if shown.sample else None
            self._texture = shown.picture.compose(mean, shown.sample), shown.request.key[-1]

    def _scene_on_gpu(self, content: SceneContent) -> GpuScene:
        params = repr(content.params())
        if self._scene is None or self._scene[0] != params:
            if isinstance(self._solids, SceneSolids):
                self._solids = GpuSolids(self._solids)
            humans = [gpu_humans().placed(human) for human in content.people]
            gpu_humans().keep_only(content.people)
            self._scene = params, GpuScene(humans, self._solids, content.background, content.step)
        return self._scene[1]

    def _draw_texture(
        self,
        engine: bpy.types.RenderEngine,
        context: bpy.types.Context,
        depsgraph: bpy.types.Depsgraph,
        texture: gpu.types.GPUTexture,
        part: Region | None,
    ) -> None:
        x, y, width, height = part or (0, 0, context.region.width, context.region.height)
        gpu.state.blend_set("ALPHA_PREMULT")
        engine.bind_display_space_shader(depsgraph.scene)
        draw_texture_2d(texture, (x, y), width, height)
        engine.unbind_display_space_shader()
        gpu.state.blend_set("NONE")


def _shown_otherwise(scene: bpy.types.Scene) -> str:
    """What to say where renders show something else than 3D views."""
    settings = scene.primdiffusion_render
    if settings.view == "COLOUR":
        return ""
    name = settings.bl_rna.properties["view"].enum_items[settings.view].name
    return f"3D views show Colour; render the image to see {name}"


def _border(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph, size: tuple[int, int]) -> Region | None:
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
