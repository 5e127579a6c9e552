"""The render engine as Blender calls it, and its settings in the render tab, saved with the scene."""

from __future__ import annotations

import bpy

from ..formats.requests import RAY_STEP
from . import final
from .viewport import Viewport
from .who_draws import ENGINE


class PRIMDIFFUSION_RenderEngine(bpy.types.RenderEngine):
    """Draws humans exactly, by marching rays through their primitives, and solid objects with simple shading."""

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
        """Combined always, Depth where the view layer has the Z pass."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """One view layer of one frame, in a thread of Blender's, in its main one under -b. Errors end the render."""
        try:
            final.render_layer(self, depsgraph)
        except (final.RenderFailed, ValueError, OSError) as error:
            self._fail(str(error))
        except Exception as error:
            self._fail(f"defect in the engine: {type(error).__name__}: {error}")
            raise

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Called when the scene has changed."""
        self._viewport = self._viewport or Viewport()
        self._viewport.update(context, depsgraph)

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw the newest picture, without waiting for one."""
        if self._viewport is None:
            self._viewport = Viewport()
            self._viewport.update(context, depsgraph)
        self._viewport.draw(self, context, depsgraph)

    def _fail(self, message: str) -> None:
        message = f"PrimDiffusion: {message}"
        self.update_stats("", message)
        self.report({"ERROR"}, message)  # ends animations too; after error_set they would continue


def _redraw(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Blender notifies viewports only of changes to its own data."""
    settings.id_data.update_tag()


class PRIMDIFFUSION_PG_render(bpy.types.PropertyGroup):
    """`scene.primdiffusion_render`."""

    step: bpy.props.FloatProperty(
        name="Step",
        description="Distance between samples along a ray: smaller is slower and finer",
        subtype="DISTANCE",
        unit="LENGTH",
        default=RAY_STEP,
        min=0.0005,
        max=0.05,
        soft_min=0.001,
        soft_max=0.016,
        step=0.1,
        precision=4,
        update=_redraw,
    )
    view: bpy.props.EnumProperty(
        name="View",
        description="What is drawn of humans",
        items=(
            ("COLOUR", "Colour", "Humans as they look"),
            ("DEPTH", "Depth", "Near is bright"),
            ("ALPHA", "Alpha", "How opaque the humans are"),
            ("BOXES", "Primitives", "The boxes that humans are made of, shaded, each in a different colour"),
        ),
        default="COLOUR",
        update=_redraw,
    )
    solids: bpy.props.EnumProperty(
        name="Solid Objects",
        description="How meshes and other surfaces are drawn",
        items=(
            ("SHADED", "Shaded", "Drawn with simple shading; they hide humans behind"),
            (
                "HOLDOUT",
                "Holdout",
                "Not drawn, but they cut holes into humans, for compositing over a Cycles render",
            ),
            ("IGNORED", "Ignored", "Humans are drawn as if they were not there"),
        ),
        default="SHADED",
        update=_redraw,
    )
    in_viewports: bpy.props.BoolProperty(
        name="Humans",
        description="Show generated humans in 3D views as the PrimDiffusion engine draws them, wherever their volumes "
        "are hidden",
        default=True,
        update=_redraw,
    )
