"""The render engine as Blender calls it.

What draws is imported when something is drawn: Blender registers the engine at each start.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from .viewport import Viewport

ENGINE = "PRIMDIFFUSION"


class PRIMDIFFUSION_RenderEngine(bpy.types.RenderEngine):
    """Draws people exactly, by marching rays through their primitives; and solid objects simply."""

    bl_idname = ENGINE
    bl_label = "PrimDiffusion"
    bl_use_preview = False
    bl_use_postprocess = True
    bl_use_shading_nodes_custom = False
    bl_use_eevee_viewport = True

    def __init__(self, *args: object, **kwargs: object):
        super().__init__(*args, **kwargs)  # without it Blender 4.5 and later draw nothing
        self._viewport: Viewport | None = None

    def update_render_passes(self, scene: bpy.types.Scene, renderlayer: bpy.types.ViewLayer) -> None:
        """Combined always, Depth where the view layer asks for Z."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """One view layer of one frame; runs beside Blender's window, or in it under -b. An error ends the render."""
        from . import final

        try:
            final.render_layer(self, depsgraph)
        except (final.RenderFailed, ValueError, OSError) as error:
            self._fail(str(error))
        except Exception as error:
            self._fail(f"defect in the engine: {type(error).__name__}: {error}")
            raise

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """The scene has changed."""
        self._viewport = self._viewport or _new_viewport()
        self._viewport.update(context, depsgraph)

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw the newest picture there is; never waits for one."""
        if self._viewport is None:
            self._viewport = _new_viewport()
            self._viewport.update(context, depsgraph)
        self._viewport.draw(self, context, depsgraph)

    def _fail(self, sentence: str) -> None:
        sentence = f"PrimDiffusion: {sentence}"
        self.update_stats("", sentence)
        self.report({"ERROR"}, sentence)  # ends the render, animations too; error_set would let them go on


def _new_viewport() -> Viewport:
    from .viewport import Viewport

    return Viewport()
