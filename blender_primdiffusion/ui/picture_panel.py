"""The panel Human from Picture."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ..capture.cameras import add_picture_camera, pictures_of
from ..formats.joints import JOINT_NAMES
from ..jobs.follow import Reporting, submit
from ..jobs.from_picture import FitPictureJob, PictureJob, PictureTask
from ..jobs.generate import show_in_place
from ..jobs.parts import complete
from ..jobs.variations import backs
from ..motion.poses import take_world_posture, world_posture
from ..scene.blend_values import setting_path
from ..scene.build import build_human
from ..scene.edit import select_human
from ..scene.human import HumanTarget, human_of, humans, named_person
from .declared import SKIP
from .drawing import BackendPanel, draw_job, property_columns
from .menus import FOLDER
from .variations_panel import draw_people

_LOWERED = {"left_shoulder": -1.0, "right_shoulder": 1.0}  # radians about z, from the T pose


class PRIMDIFFUSION_PG_picture(bpy.types.PropertyGroup):
    """`scene.primdiffusion_picture`."""

    __slots__ = ()
    mask: bpy.props.StringProperty(
        name="Mask",
        description="Picture of the same size, white where the person is; not needed for a picture with alpha",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    backs: bpy.props.IntProperty(
        name="Backs",
        description="How many other backs to draw, to choose from; the human itself gets the most probable one",
        default=4,
        max=16,
        min=0,
    )


class PRIMDIFFUSION_OT_choose_picture(Reporting, bpy.types.Operator):
    """Choose pictures of one person, of which the first becomes the background of a new camera of its size"""

    bl_idname = "primdiffusion.choose_picture"
    bl_label = "Choose Picture"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="Picture", description="PNG or JPEG file", subtype="FILE_PATH", options=SKIP
    )
    directory: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", options=SKIP)
    files: bpy.props.CollectionProperty(name="Pictures", type=bpy.types.OperatorFileListElement, options=SKIP)
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Open the file browser unless a file is given."""
        if self.filepath or self.files:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> set[str]:
        folder, names = Path(bpy.path.abspath(self.directory)), [file.name for file in self.files if file.name]
        paths = [folder / name for name in names] or [Path(bpy.path.abspath(self.filepath))]
        if not (names or self.filepath):
            raise ValueError("choose a picture first")
        if len(paths) > 8:  # each adds seconds to every step of the fit
            raise ValueError(f"{len(paths)} pictures are chosen: choose up to 8 of one person")
        person = _posed(context)
        place = np.zeros(3) if person is None else np.array(person.matrix_world.translation)
        camera = add_picture_camera(context, paths, place)
        marked = all(image.depth in (32, 128) for image in pictures_of(camera))  # bits of a pixel with alpha
        if person is None and not (marked or context.scene.primdiffusion_picture.mask):
            _stand(context, build_human(context, min(FOLDER.glob("*.human"))))
            self.report({"INFO"}, "Pose the human over the person in the picture, then press Make Human.")
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
            bpy.ops.view3d.view_center_camera()
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
    back: bpy.props.IntProperty(name="Back", description="Number of the back to show, from 1 on", min=0, options=SKIP)

    def act(self, context: bpy.types.Context) -> set[str]:
        complete()
        if self.back:
            return _show_back(context, self.back)
        asked = context.scene.primdiffusion_picture
        mask = setting_path(asked.mask, "Mask")
        person = named_person(context, self.human) if self.human else _posed(context)
        if self.only_fit and person is None:
            raise ValueError("select the human that is posed over the picture: there is none to fit")
        target = HumanTarget.of(person) if self.only_fit else None
        task = PictureTask.of(context, mask, person)
        if target is not None:
            return submit(self, context, FitPictureJob(task, target))
        return submit(self, context, PictureJob(task, asked.backs, 0 if person is None else person.session_uid))


def _show_back(context: bpy.types.Context, number: int) -> set[str]:
    """Have the human show another one of the backs, whose number is from 1 on, in one step of undo."""
    person = next((one for one in humans(context.scene) if one.session_uid == backs.of), None)
    if person is None or number > len(backs.variations):
        raise ValueError("there is no such back: make the human of a picture first")
    select_human(context, person)
    show_in_place(context, person, backs.variations[number - 1])
    bpy.ops.ed.undo_push(message="Show Back")
    return {"FINISHED"}


def _stand(context: bpy.types.Context, person: bpy.types.Object) -> None:
    """Select a new human, to be posed over the picture, with lowered arms."""
    context.view_layer.update()
    select_human(context, person)
    pose, translation = world_posture(person)
    pose[list(map(JOINT_NAMES.index, _LOWERED)), 2] = list(_LOWERED.values())
    take_world_posture(person, pose, translation)


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
        images, person = pictures_of(context.scene.camera), _posed(context)
        layout.operator("primdiffusion.choose_picture", icon="IMAGE_DATA")
        for image in images:
            layout.label(text=image.name, icon="CAMERA_DATA", translate=False)
        if len(images) < 2:
            layout.prop(asked, "mask")
        layout.prop(asked, "backs")
        missing = "" if images else "Choose a picture first."
        reason = missing or ("" if person is not None else "Select a human posed over the picture to fit it.")
        fit = draw_job(layout, "fit_picture", "primdiffusion.human_from_picture", "SNAP_ON", reason, text="Fit")
        fit.only_fit = True
        draw_job(
            layout, "from_picture", "primdiffusion.human_from_picture", "ARMATURE_DATA", missing, text="Make Human"
        )
        if backs.variations and person is not None and person.session_uid == backs.of:
            layout.label(text="Other backs")
            for index, _, cell in draw_people(layout, context, backs):
                use = cell.operator("primdiffusion.human_from_picture", text=f"Use {index + 1}", translate=False)
                use.back = index + 1


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
