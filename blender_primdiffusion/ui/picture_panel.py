"""The panel Human from Picture."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ..capture.cameras import add_picture_camera, picture_of
from ..jobs.follow import Reporting, submit
from ..jobs.from_picture import FitPictureJob, PictureJob, PictureTask
from ..jobs.parts import complete
from ..scene.blend_values import setting_path
from ..scene.human import HumanTarget, human_of, named_person
from .declared import SKIP
from .drawing import BackendPanel, draw_job, property_columns


class PRIMDIFFUSION_PG_picture(bpy.types.PropertyGroup):
    """`scene.primdiffusion_picture`."""

    mask: bpy.props.StringProperty(
        name="Mask",
        description="Picture of the same size, white where the person is; not needed for a picture with alpha",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    seed: bpy.props.IntProperty(
        name="Seed",
        description="Random seed for parts not visible in the picture; -1 uses the most likely appearance",
        default=-1,
        min=-1,
    )


class PRIMDIFFUSION_OT_choose_picture(Reporting, bpy.types.Operator):
    """Choose a picture of one person, which becomes the background of a new camera of its size"""

    bl_idname = "primdiffusion.choose_picture"
    bl_label = "Choose Picture"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="Picture", description="PNG or JPEG file", subtype="FILE_PATH", options=SKIP
    )
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Open the file browser unless a file is given."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> set[str]:
        path = bpy.path.abspath(self.filepath)
        if not path:
            raise ValueError("choose a picture first")
        person = _posed(context)
        place = np.zeros(3) if person is None else np.array(person.matrix_world.translation)
        add_picture_camera(context, Path(path), place)
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
        return {"FINISHED"}


class PRIMDIFFUSION_OT_human_from_picture(Reporting, bpy.types.Operator):
    """Make the human in the picture; the search for its pose starts from the selected human's, or from standing"""

    bl_idname = "primdiffusion.human_from_picture"
    bl_label = "Human from Picture"
    described_by = ("only_fit",)

    only_fit: bpy.props.BoolProperty(
        name="Fit Only",
        description="Refine pose and shape of the selected human, and the camera, until they match the picture",
        options=SKIP,
    )
    human: bpy.props.StringProperty(
        name="Human",
        description="Name of the human posed over the picture; empty: the selected one, if any",
        options=SKIP,
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        complete()
        asked = context.scene.primdiffusion_picture
        mask = setting_path(asked.mask, "Mask")
        person = named_person(context, self.human) if self.human else _posed(context)
        if self.only_fit and person is None:
            raise ValueError("select the human that is posed over the picture: there is none to fit")
        target = HumanTarget.of(person) if self.only_fit else None
        task = PictureTask.of(context, mask, person)
        if target is not None:
            return submit(self, context, FitPictureJob(task, target))
        return submit(self, context, PictureJob(task, asked.seed, 0 if person is None else person.session_uid))


def _posed(context: bpy.types.Context) -> bpy.types.Object | None:
    """The human of the active object, if that is selected."""
    active = context.view_layer.objects.active
    return human_of(active) if active is not None and active.select_get() else None


class PRIMDIFFUSION_PT_human_from_picture(BackendPanel, bpy.types.Panel):
    """Picture, mask, Fit and Make Human; progress and errors."""

    bl_label = "Human from Picture"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "picture"

    def draw(self, context: bpy.types.Context) -> None:
        layout, asked = property_columns(self.layout), context.scene.primdiffusion_picture
        image, person = picture_of(context.scene.camera), _posed(context)
        layout.operator("primdiffusion.choose_picture", icon="IMAGE_DATA")
        if image is not None:
            layout.label(text=image.name, icon="CAMERA_DATA", translate=False)
        layout.prop(asked, "mask")
        layout.prop(asked, "seed")
        missing = "" if image is not None else "Choose a picture first."
        reason = missing or ("" if person is not None else "Select a human posed over the picture to fit it.")
        fit = draw_job(layout, "fit_picture", "primdiffusion.human_from_picture", "SNAP_ON", reason, text="Fit")
        fit.only_fit = True
        draw_job(
            layout, "from_picture", "primdiffusion.human_from_picture", "ARMATURE_DATA", missing, text="Make Human"
        )


class PRIMDIFFUSION_FH_picture(bpy.types.FileHandler):
    """Pictures, while the panel's tab is open: otherwise Blender places a dropped picture as it always does."""

    bl_idname = "PRIMDIFFUSION_FH_picture"
    bl_label = "Human from Picture"
    bl_import_operator = "primdiffusion.choose_picture"
    bl_file_extensions = ".png;.jpg;.jpeg"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        if context.area is None or context.area.type != "VIEW_3D" or not context.space_data.show_region_ui:
            return False
        tabs = (region.active_panel_category for region in context.area.regions if region.type == "UI")
        return PRIMDIFFUSION_PT_human_from_picture.bl_category in tabs


PROPERTIES = ((bpy.types.Scene, "primdiffusion_picture", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_picture)),)
