"""The 3D view in Rendered mode, marched on the GPU that draws it."""

from __future__ import annotations

import functools
import weakref

import bpy
import gpu
from gpu_extras.presets import draw_texture_2d

from .gpu.march import GpuMarch, gpu_marcher
from .gpu.picture import GpuPicture, GpuScene, GpuSolids
from .gpu.refine import GpuRefinement, MarchRequest
from .gpu.scene_reading import gpu_humans
from .picture import SceneContent, SceneSolids, changed_by, scene_content, scene_solids
from .view import region_view

below_overlays: weakref.WeakValueDictionary[int, GpuMarch] = weakref.WeakValueDictionary()
"""The humans of a view, by the region's address, until Blender has drawn its overlays over them."""


class Viewport:
    """One region in Rendered mode. All methods are for Blender's main thread, `draw` for its drawing."""

    def __init__(self) -> None:
        self._refinement = GpuRefinement()
        self._content: SceneContent | None = None
        self._solids: SceneSolids | GpuSolids | None = None
        """On the GPU once they have been drawn."""
        self._local: bool | None = None
        """Whether the view was local when solids were read last."""
        self._scene: tuple[str, GpuScene] | None = None
        """With the parameters of the content that it shows; None when the solids have changed."""
        self._texture: gpu.types.GPUTexture | None = None
        """What is drawn."""
        self._error = ""
        """Why the scene cannot be drawn."""
        self._fault = ""
        """Why the GPU cannot draw, which is not tried again."""

    def update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Read the changed scene while the dependency graph may be read."""
        space = context.space_data
        local = space.local_view is not None
        try:
            if local != self._local or changed_by(depsgraph):
                solids = scene_solids(depsgraph, space)
                self._solids = solids if len(solids.corners) else None
                self._local, self._scene = local, None
            self._content = scene_content(depsgraph, None, space)
            self._error = ""
        except (ValueError, OSError) as error:
            self._content, self._error = None, str(error)

    def draw(self, engine: bpy.types.RenderEngine, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """March what the region shows now for a moment, and draw what has come of it."""
        if self._local not in (None, context.space_data.local_view is not None):
            self.update(context, depsgraph)  # Blender reports no change
        if self._content is not None and not self._fault:
            try:
                self._march(self._content, context)
            except (ValueError, OSError) as error:  # until the scene changes
                self._content, self._error = None, str(error)
            except RuntimeError as error:
                self._fault = str(error)
        if not self.resting:
            engine.tag_redraw()
        if self._texture is not None:
            gpu.state.blend_set("ALPHA_PREMULT")
            engine.bind_display_space_shader(depsgraph.scene)
            draw_texture_2d(self._texture, (0, 0), context.region.width, context.region.height)
            engine.unbind_display_space_shader()
            gpu.state.blend_set("NONE")
            below_overlays[context.region.as_pointer()] = self._refinement.shown.picture.humans
        status = self._fault or self._error
        engine.update_stats("", f"PrimDiffusion: {status}" if status else "")

    @property
    def resting(self) -> bool:
        """Whether no new picture is expected."""
        return self._content is None or bool(self._fault) or self._refinement.resting

    def _march(self, content: SceneContent, context: bpy.types.Context) -> None:
        """March for a moment. Raises ValueError or OSError for a human who cannot be drawn, RuntimeError without a GPU
        that can."""
        marcher, scene, view = gpu_marcher(), self._scene_on_gpu(content), region_view(context, content.subject)
        key = (scene, repr(view.params()))
        self._refinement.want(MarchRequest(key, view, functools.partial(GpuPicture, marcher, scene)))
        if self._refinement.advance():
            shown = self._refinement.shown
            self._texture = shown.picture.compose(self._texture if shown.sample else None, shown.sample)

    def _scene_on_gpu(self, content: SceneContent) -> GpuScene:
        params = repr(content.params())
        if self._scene is None or self._scene[0] != params:
            if isinstance(self._solids, SceneSolids):
                self._solids = GpuSolids(self._solids)
            humans = [gpu_humans().placed(human) for human in content.people]
            gpu_humans().keep_only(content.people)
            self._scene = params, GpuScene(humans, self._solids, content.background, content.step)
        return self._scene[1]
