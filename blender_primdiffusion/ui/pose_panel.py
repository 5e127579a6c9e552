"""The sub-panel Pose Library: apply, mirror, reset, key, save and delete poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy

from ..formats.joints import JOINT_NAMES
from ..motion.own_poses import delete_pose, load_pose, own_poses, save_pose
from .drawing import SidebarPanel, property_columns
from .manual import draw_manual_button
from .motion_armatures import OnArmature, warn_of_rest
from .pose_pictures import draw_picture, free, look_again, pose_items, poses_folder
from .translations import CONTEXT

if TYPE_CHECKING:
    from numpy.typing import NDArray


class PRIMDIFFUSION_PG_motion(bpy.types.PropertyGroup):
    """Of a scene."""

    pose: bpy.props.EnumProperty(name="Pose", description="The pose to apply", items=pose_items)
    amount: bpy.props.FloatProperty(
        name="Amount",
        description="Strength of the pose: 0 none, 1 full",
        default=1.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    mirror: bpy.props.BoolProperty(name="Mirror", description="Swap left and right", default=False)
    only_selected: bpy.props.BoolProperty(
        name="Only Selected Bones",
        translation_context=CONTEXT,
        description="Change only the selected bones",
        default=False,
    )


_SKIP = {"SKIP_SAVE"}


class _Posing(OnArmature):
    """What the operators that change a pose have in common."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    only_selected: bpy.props.BoolProperty(
        name="Only Selected Bones", description="Change only the selected bones", default=False
    )

    def joints(self, armature: bpy.types.Object) -> list[str]:
        """Which to change. Raises ValueError where none is selected."""
        from ..motion.pose_library import selected_joints

        if not self.only_selected:
            return list(JOINT_NAMES)
        chosen = selected_joints(armature)
        if not chosen:
            raise ValueError(f"no bone of {armature.name!r} is selected: select some in Pose Mode")
        return chosen

    def pose(
        self,
        context: bpy.types.Context,
        armature: bpy.types.Object,
        pose: NDArray,
        translation: NDArray | None,
        amount: float,
    ) -> set[str]:
        """Apply, and key where auto keying is on."""
        from ..motion.pose_library import apply_pose, key_pose

        joints = self.joints(armature)
        changed = apply_pose(armature, pose, translation, amount, joints)
        if context.scene.tool_settings.use_keyframe_insert_auto and changed:
            key_pose(armature, context.scene.frame_current, changed)
        locked = len(joints) - len(changed)
        if locked:
            self.report({"WARNING"}, f"{locked} locked bones of {armature.name!r} were not changed")
        warn_of_rest(self, armature)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_apply_pose(_Posing, bpy.types.Operator):
    """Apply the chosen pose of the library to the person"""

    bl_idname = "primdiffusion.apply_pose"
    bl_label = "Apply Pose"

    pose_name: bpy.props.StringProperty(
        name="Pose", description="Name of the pose in the library; empty: the panel's", options=_SKIP
    )
    amount: bpy.props.FloatProperty(
        name="Amount",
        description="Strength of the pose: 0 none, 1 full",
        default=1.0,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
    )
    mirror: bpy.props.BoolProperty(name="Mirror", description="Swap left and right", default=False)
    ground: bpy.props.BoolProperty(
        name="Feet on the Floor", description="Move the body down until the feet are on the floor", default=True
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """From the panel's settings."""
        settings = context.scene.primdiffusion_motion
        if not self.pose_name:
            self.pose_name = settings.pose
        for name in ("amount", "mirror", "only_selected"):
            if not self.properties.is_property_set(name):
                setattr(self, name, getattr(settings, name))
        return self.execute(context)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Find the pose and apply it."""
        from ..motion.pose_library import builtin_poses, mirrored, standing

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
        return self.pose(context, armature, pose, translation, self.amount)


class PRIMDIFFUSION_OT_mirror_pose(_Posing, bpy.types.Operator):
    """Swap left and right of the person's pose"""

    bl_idname = "primdiffusion.mirror_pose"
    bl_label = "Mirror Pose"

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Turn the present pose over."""
        from ..motion.pose_library import current_pose, mirrored
        from ..motion.rotation import to_axis_angle

        rotations, translation = current_pose(armature)
        return self.pose(context, armature, mirrored(to_axis_angle(rotations)), translation * [-1.0, 1.0, 1.0], 1.0)


class PRIMDIFFUSION_OT_reset_pose(_Posing, bpy.types.Operator):
    """Reset the person to the rest pose"""

    bl_idname = "primdiffusion.reset_pose"
    bl_label = "Reset to Rest"

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """No turn and no move."""
        import numpy as np

        return self.pose(context, armature, np.zeros((len(JOINT_NAMES), 3)), np.zeros(3), 1.0)


class PRIMDIFFUSION_OT_key_pose(OnArmature, bpy.types.Operator):
    """Set keyframes of the person's pose on the current frame"""

    bl_idname = "primdiffusion.key_pose"
    bl_label = "Key Pose"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """All of SMPL's joints, and where the pelvis is."""
        from ..motion.pose_library import key_pose

        key_pose(armature, context.scene.frame_current)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_save_pose(OnArmature, bpy.types.Operator):
    """Save the person's pose in the library, for this and other files"""

    bl_idname = "primdiffusion.save_pose"
    bl_label = "Save Pose"
    bl_options: set[str] = set()  # noqa: RUF012  a file cannot be undone

    pose_name: bpy.props.StringProperty(name="Name", description="Of the new pose", default="My Pose", options=_SKIP)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Ask for a name."""
        return context.window_manager.invoke_props_dialog(self)

    def on(self, context: bpy.types.Context, armature: bpy.types.Object) -> set[str]:
        """Write the file and choose it in the panel."""
        from ..motion.pose_library import builtin_poses, current_pose
        from ..motion.rotation import to_axis_angle

        name = self.pose_name.strip()
        if name in builtin_poses():
            raise ValueError(f"{name!r} is a built-in pose: give yours another name")
        rotations, translation = current_pose(armature)
        path = save_pose(poses_folder(), name, to_axis_angle(rotations), translation)
        try:
            draw_picture(path, rotations)
        except OSError as error:
            self.report({"WARNING"}, f"The pose {name!r} has no picture: {error}")
        look_again()
        context.scene.primdiffusion_motion.pose = name
        self.report({"INFO"}, f"The pose {name!r} is in the library")
        return {"FINISHED"}


class PRIMDIFFUSION_OT_delete_pose(bpy.types.Operator):
    """Delete the chosen pose from your own poses in the library, for all .blend files"""

    bl_idname = "primdiffusion.delete_pose"
    bl_label = "Delete Pose"
    bl_options: set[str] = set()  # noqa: RUF012  a file cannot be undone

    pose_name: bpy.props.StringProperty(name="Pose", description="Empty: the panel's", options=_SKIP)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the file."""
        settings = context.scene.primdiffusion_motion
        name = self.pose_name or settings.pose
        own = own_poses(poses_folder())
        if name not in own:
            self.report({"ERROR"}, f"{name!r} is not one of your own poses: only those can be deleted")
            return {"CANCELLED"}
        try:
            delete_pose(own[name])
            look_again()
        except OSError as error:
            self.report({"ERROR"}, f"{str(own[name])!r} could not be deleted ({error.strerror or error})")
            return {"CANCELLED"}
        settings.property_unset("pose")
        return {"FINISHED"}


class PRIMDIFFUSION_PT_poses(SidebarPanel, bpy.types.Panel):
    """Poses with pictures."""

    bl_label = "Pose Library"
    bl_parent_id = "PRIMDIFFUSION_PT_human"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual."""
        draw_manual_button(self.layout, "posing")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout = property_columns(self.layout)
        settings = context.scene.primdiffusion_motion
        layout.template_icon_view(settings, "pose", show_labels=True, scale=6.0, scale_popup=5.0)
        layout.label(text=settings.pose)
        layout.prop(settings, "amount", slider=True)
        layout.prop(settings, "mirror")
        layout.prop(settings, "only_selected")
        layout.operator("primdiffusion.apply_pose", icon="ARMATURE_DATA")
        row = layout.row(align=True)
        row.operator("primdiffusion.mirror_pose", icon="MOD_MIRROR")
        row.operator("primdiffusion.reset_pose", icon="LOOP_BACK")
        row = layout.row(align=True)
        row.operator("primdiffusion.save_pose", icon="ADD")
        if settings.pose in own_poses(poses_folder()):
            row.operator("primdiffusion.delete_pose", icon="TRASH")


CLASSES = (
    PRIMDIFFUSION_PG_motion,
    PRIMDIFFUSION_OT_apply_pose,
    PRIMDIFFUSION_OT_mirror_pose,
    PRIMDIFFUSION_OT_reset_pose,
    PRIMDIFFUSION_OT_key_pose,
    PRIMDIFFUSION_OT_save_pose,
    PRIMDIFFUSION_OT_delete_pose,
    PRIMDIFFUSION_PT_poses,
)
PROPERTIES = ((bpy.types.Scene, "primdiffusion_motion", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_motion)),)


def unregister() -> None:
    """Release the pictures."""
    free()
