"""The panel Pose Library: apply, mirror, reset, key, save and delete poses."""

from __future__ import annotations

import zlib
from pathlib import Path

import bpy
import numpy as np
from bpy.utils import previews
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.rotation import to_axis_angle
from ..motion.pose_library import (
    apply_pose,
    builtin_poses,
    check_posable,
    current_pose,
    delete_pose,
    key_pose,
    load_pose,
    mirrored,
    own_poses,
    picture_of,
    save_pose,
    selected_joints,
    standing,
)
from ..motion.poses import LIBRARY
from ..places import own_folder
from ..scene.handles import add_handles, bake_handles, handles_from_joints, has_handles, joints_from_handles
from .declared import SKIP
from .drawing import SidebarPanel, property_columns
from .on_person import OnArmature, may_have_joints, target_armature, warn_of_rest

_PICTURES = Path(__file__).parents[1] / "motion" / "data" / "thumbnails"
_collections: list = []
"""The collection of previews, once it is loaded."""
_items: list[tuple[str, str, str, int, int]] = []
"""Holds the strings of the dynamic menu, to which Blender holds no references."""


def poses_folder() -> Path:
    """Folder of the user's poses."""
    return own_folder() / "poses"


def pose_items(_self, _context: bpy.types.Context) -> list[tuple[str, str, str, int, int]]:
    """Built-in poses first, then the user's own."""
    own = own_poses(poses_folder())
    wanted = [*LIBRARY, *(name for name in own if name not in LIBRARY)]
    if [item[0] for item in _items] != wanted:
        built_in = [
            (name, name, "A built-in pose", _icon(_PICTURES / f"{name}.png"), number)
            for number, name in enumerate(LIBRARY)
        ]
        _items[:] = built_in + [
            (name, name, "A pose of your own", _icon(picture_of(own[name])), _number(name))
            for name in wanted[len(LIBRARY) :]
        ]
    return _items


def reload_poses() -> None:
    """Read the list again after a pose was saved or deleted."""
    _items.clear()


def _number(name: str) -> int:
    """The number that a .blend saves: depends only on the name, and is beyond those of the built-in poses."""
    return zlib.crc32(name.encode()) & 0x3FFFFFFF | 0x40000000


def _icon(picture: Path) -> int:
    try:
        key = f"{picture} {picture.stat().st_mtime_ns}"
    except OSError:  # a pose without a picture
        return bpy.types.UILayout.bl_rna.functions["prop"].parameters["icon"].enum_items["ARMATURE_DATA"].value
    if not _collections:
        _collections.append(previews.new())
    loaded = _collections[0]
    if key not in loaded:
        loaded.load(key, str(picture), "IMAGE")
    return loaded[key].icon_id


def free() -> None:
    """Free the pictures."""
    _items.clear()
    while _collections:
        previews.remove(_collections.pop())


_AMOUNT = bpy.props.FloatProperty(
    name="Amount", description="Strength of the pose: 0 none, 1 full", default=1.0, min=0.0, max=1.0, subtype="FACTOR"
)
_MIRROR = bpy.props.BoolProperty(name="Mirror", description="Swap left and right", default=False)
_ONLY_SELECTED = bpy.props.BoolProperty(
    name="Only Selected Bones", description="Change only the selected bones", default=False
)


class PRIMDIFFUSION_PG_motion(bpy.types.PropertyGroup):
    """Motion settings of a scene."""

    pose: bpy.props.EnumProperty(name="Pose", description="The pose to apply", items=pose_items)
    amount: _AMOUNT
    mirror: _MIRROR
    only_selected: _ONLY_SELECTED


class _Posing(OnArmature):
    """Base of the operators that change a pose."""

    bl_options = {"REGISTER", "UNDO"}
    only_selected: _ONLY_SELECTED

    def joints(self, armature: bpy.types.Object) -> list[str]:
        """Which to change. Raises ValueError where none is selected."""
        if not self.only_selected:
            return list(JOINT_NAMES)
        chosen = selected_joints(armature)
        if not chosen:
            raise ValueError(f"no bone of {armature.name!r} is selected: select some in Pose Mode")
        return chosen

    def pose(self, armature: bpy.types.Object, pose: NDArray, translation: NDArray | None, amount: float) -> list[str]:
        """Apply a pose; returns the bones that it changed."""
        joints = self.joints(armature)
        changed = apply_pose(armature, pose, translation, amount, joints)
        if locked := len(joints) - len(changed):
            self.report({"WARNING"}, f"{locked} locked bones of {armature.name!r} were not changed")
        return changed

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Keys the pose where auto keying is on."""
        check_posable(armature)
        joints_from_handles(context, armature)
        changed = self.apply(context, armature)
        handles_from_joints(context, armature)
        if context.scene.tool_settings.use_keyframe_insert_auto and changed:
            key_pose(armature, context.scene.frame_current, changed)
        warn_of_rest(self, armature)
        return {"FINISHED"}

    def apply(self, context: bpy.types.Context, armature: bpy.types.Object) -> list[str]:
        """Change the pose; returns the bones changed."""
        raise NotImplementedError


_POSES = (
    ("LIBRARY", "Of the Library", "Apply the chosen pose of the library to the human"),
    ("MIRRORED", "Mirrored", "Swap left and right of the human's pose"),
    ("REST", "Rest", "Reset the human to the rest pose"),
)


class PRIMDIFFUSION_OT_apply_pose(_Posing, bpy.types.Operator):
    """Apply the chosen pose of the library to the human, mirror its pose, or reset it to rest"""

    bl_idname = "primdiffusion.apply_pose"
    bl_label = "Apply Pose"
    described_by = ("what",)

    what: bpy.props.EnumProperty(name="Pose To Apply", description="Which pose", items=_POSES, options=SKIP)
    pose_name: bpy.props.StringProperty(
        name="Pose", description="Name of the pose in the library; empty: the panel's", options=SKIP
    )
    amount: _AMOUNT
    mirror: _MIRROR
    ground: bpy.props.BoolProperty(
        name="Feet on the Floor", description="Move the body down until the feet are on the floor", default=True
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.what != "LIBRARY":
            return self.execute(context)
        settings = context.scene.primdiffusion_motion
        if not self.pose_name:
            self.pose_name = settings.pose
        for name in ("amount", "mirror", "only_selected"):
            setattr(self, name, self.chosen(name, settings))
        return self.execute(context)

    def draw(self, _context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
        layout.prop(self, "what")
        if self.what == "LIBRARY":
            for name in ("pose_name", "amount", "mirror", "ground"):
                layout.prop(self, name)
        layout.prop(self, "only_selected")

    def apply(self, context: bpy.types.Context, armature: bpy.types.Object) -> list[str]:
        if self.what == "REST":
            return self.pose(armature, np.zeros((len(JOINT_NAMES), 3)), np.zeros(3), 1.0)
        if self.what == "MIRRORED":
            rotations, translation = current_pose(armature)
            return self.pose(armature, mirrored(to_axis_angle(rotations)), translation * [-1.0, 1.0, 1.0], 1.0)
        return self._apply(context, armature)

    def _apply(self, context: bpy.types.Context, armature: bpy.types.Object) -> list[str]:
        """A pose of the library."""
        name = self.pose_name or context.scene.primdiffusion_motion.pose
        own = own_poses(poses_folder())
        if name in builtin_poses():
            pose, translation = builtin_poses()[name], None
        elif name in own:
            pose, translation = load_pose(own[name])
        else:
            raise ValueError(f"there is no pose {name!r} in the library: choose from {', '.join(builtin_poses())}")
        if self.mirror:
            pose = mirrored(pose)
            translation = None if translation is None else translation * [-1.0, 1.0, 1.0]
        if translation is None and self.ground:
            translation = standing(armature, pose)
        return self.pose(armature, pose, translation, self.amount)


class PRIMDIFFUSION_OT_key_pose(OnArmature, bpy.types.Operator):
    """Set keyframes of the human's pose on the current frame"""

    bl_idname = "primdiffusion.key_pose"
    bl_label = "Key Pose"
    bl_options = {"REGISTER", "UNDO"}

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        joints_from_handles(context, armature)
        key_pose(armature, context.scene.frame_current)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_save_pose(OnArmature, bpy.types.Operator):
    """Save the human's pose in the library, for this and other files"""

    bl_idname = "primdiffusion.save_pose"
    bl_label = "Save Pose"
    described_by = ("delete",)

    pose_name: bpy.props.StringProperty(
        name="Name", description="Name of the new pose, or of the one to delete", default="My Pose", options=SKIP
    )
    delete: bpy.props.BoolProperty(
        name="Delete",
        description="Delete the chosen pose from your own poses in the library, for all .blend files",
        options=SKIP,
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.delete:
            return context.window_manager.invoke_confirm(self, event)
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.prop(self, "pose_name")

    def act(self, context: bpy.types.Context) -> set[str]:
        return self._delete(context.scene.primdiffusion_motion) if self.delete else super().act(context)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        name = self.pose_name.strip()
        if name in builtin_poses():
            raise ValueError(f"{name!r} is a built-in pose: give yours another name")
        joints_from_handles(context, armature)
        rotations, translation = current_pose(armature)
        save_pose(poses_folder(), name, to_axis_angle(rotations), translation)
        reload_poses()
        context.scene.primdiffusion_motion.pose = name
        self.report({"INFO"}, f"The pose {name!r} is in the library")
        return {"FINISHED"}

    def _delete(self, settings: PRIMDIFFUSION_PG_motion) -> set[str]:
        """One of the user's own poses: the one named, else the panel's. A file cannot be undone."""
        name = self.pose_name if self.given("pose_name") else settings.pose
        own = own_poses(poses_folder())
        if name not in own:
            raise ValueError(f"{name!r} is not one of your own poses: only those can be deleted")
        try:
            delete_pose(own[name])
            reload_poses()
        except OSError as error:
            raise OSError(f"{str(own[name])!r} could not be deleted ({error.strerror or error})") from error
        settings.property_unset("pose")
        return {"FINISHED"}


class PRIMDIFFUSION_OT_add_handles(OnArmature, bpy.types.Operator):
    """Add handles that hold hands and feet where they are (IK), and poles that elbows and knees point to"""

    bl_idname = "primdiffusion.add_handles"
    bl_label = "Add IK Handles"
    bl_options = {"REGISTER", "UNDO"}

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        add_handles(context, armature)
        warn_of_rest(self, armature)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_bake_handles(OnArmature, bpy.types.Operator):
    """Turn the joints as the IK handles show, on every frame where the pose is animated, and remove the handles"""

    bl_idname = "primdiffusion.bake_handles"
    bl_label = "Bake and Remove Handles"
    bl_options = {"REGISTER", "UNDO"}

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        check_posable(armature)
        bake_handles(context, armature)
        return {"FINISHED"}


def draw_handles(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The button that adds handles, or the one that bakes them."""
    try:
        armature = target_armature(context)
    except ValueError:
        return
    name = "bake_handles" if has_handles(armature) else "add_handles"
    layout.operator(f"primdiffusion.{name}", icon="CON_KINEMATIC")


class PRIMDIFFUSION_PT_poses(SidebarPanel, bpy.types.Panel):
    """Poses with pictures."""

    bl_label = "Pose Library"
    bl_parent_id = "PRIMDIFFUSION_PT_human"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "posing"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return may_have_joints(context)

    def draw(self, context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
        settings = context.scene.primdiffusion_motion
        layout.template_icon_view(settings, "pose", show_labels=True, scale=6.0, scale_popup=5.0)
        layout.label(text=settings.pose)
        layout.prop(settings, "amount", slider=True)
        layout.prop(settings, "mirror")
        layout.prop(settings, "only_selected")
        layout.operator("primdiffusion.apply_pose", icon="ARMATURE_DATA")
        row = layout.row(align=True)
        row.operator("primdiffusion.apply_pose", text="Mirror Pose", icon="MOD_MIRROR").what = "MIRRORED"
        row.operator("primdiffusion.apply_pose", text="Reset to Rest", icon="LOOP_BACK").what = "REST"
        row = layout.row(align=True)
        row.operator("primdiffusion.save_pose", icon="ADD")
        if settings.pose in own_poses(poses_folder()):
            row.operator("primdiffusion.save_pose", text="Delete Pose", icon="TRASH").delete = True
        draw_handles(layout, context)


PROPERTIES = ((bpy.types.Scene, "primdiffusion_motion", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_motion)),)


def unregister() -> None:
    """Free the pictures."""
    free()
