"""Operators on the scene's rendering: which engine, and something to see people with."""

from __future__ import annotations

import math

import bpy
from mathutils import Euler, Vector

from ...engine.engine import ENGINE
from ...scene.human import human_of

_SAMPLES = 4
_YAW = math.radians(20)


class PRIMDIFFUSION_OT_set_up_engine(bpy.types.Operator):
    """Render with PrimDiffusion: exact, seconds a picture; other objects are shaded simply"""

    bl_idname = "primdiffusion.set_up_engine"
    bl_label = "PrimDiffusion (Exact)"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The engine, and the view transform in which its colours are those of the people."""
        context.scene.render.engine = ENGINE
        _plain_colours(context.scene)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_set_up_cycles(bpy.types.Operator):
    """Render with Cycles: people are approximated, shadows and lights on other objects are right"""

    bl_idname = "primdiffusion.set_up_cycles"
    bl_label = "Cycles (Approximate)"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Settings fit for a thousand volumes; camera, world, film and bounces of light between objects stay."""
        from ...scene.preview import fit_cycles_to_volumes

        scene = context.scene
        if not hasattr(scene, "cycles"):
            self.report({"ERROR"}, "Cycles is switched off: enable the add-on Cycles Render Engine in the preferences")
            return {"CANCELLED"}
        scene.render.engine = "CYCLES"
        bounces = scene.cycles.max_bounces
        fit_cycles_to_volumes(scene, _SAMPLES)
        scene.cycles.max_bounces = bounces
        _plain_colours(scene)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_add_camera(bpy.types.Operator):
    """Add a camera that frames the selected person, or everybody, and a sun for other objects"""

    bl_idname = "primdiffusion.add_camera"
    bl_label = "Add Camera and Light"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The camera becomes the scene's."""
        from ...scene.preview import frame_box, humans_extent, new_camera, posed_extent

        scene = context.scene
        person = human_of(context.view_layer.objects.active, scene)
        try:
            extent = humans_extent(scene) if person is None else posed_extent(person)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        camera = new_camera(scene)
        camera.name = camera.data.name = "Human Camera"
        frame_box(camera, extent, _YAW, (scene.render.resolution_x, scene.render.resolution_y))
        scene.camera = camera
        sun = bpy.data.objects.new("Human Sun", bpy.data.lights.new("Human Sun", "SUN"))
        sun.data.energy = 3.0
        sun.rotation_euler = Euler((math.radians(40), 0, math.radians(30)))
        sun.location = camera.location + Vector((0, 0, 2))
        scene.collection.objects.link(sun)
        return {"FINISHED"}


def _plain_colours(scene: bpy.types.Scene) -> None:
    """Other transforms change the colours that people were made with."""
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


OPERATORS = (PRIMDIFFUSION_OT_set_up_engine, PRIMDIFFUSION_OT_set_up_cycles, PRIMDIFFUSION_OT_add_camera)
