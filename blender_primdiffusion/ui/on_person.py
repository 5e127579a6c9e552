"""Bases of operators on one human, or on one armature with SMPL's joints."""

from __future__ import annotations

import bpy

from ..formats.joints import JOINT_NAMES
from ..jobs.follow import Reporting
from ..jobs.parts import complete
from ..scene.human import human_of, humans, named_person, selected_person
from .declared import SKIP


class HumanOperator(Reporting):
    """Base of operators on one human, which it finds; subclasses define `run`."""

    human: bpy.props.StringProperty(
        name="Human", description="Name of the human; empty: the selected human", options=SKIP
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        found = bool(humans(context.scene))
        if not found:
            cls.poll_message_set("There is no human in the scene: add one first")
        return found

    def act(self, context: bpy.types.Context) -> set[str]:
        complete()
        return self.run(context, self.person(context))

    def person(self, context: bpy.types.Context) -> bpy.types.Object:
        """The human named, else the selected one. Raises ValueError."""
        return named_person(context, self.human) if self.human else selected_person(context)

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        """The operator itself."""
        raise NotImplementedError


def other_human(context: bpy.types.Context, person: bpy.types.Object) -> bpy.types.Object:
    """The other human, picked in the panel. Raises ValueError."""
    picked = context.scene.primdiffusion_edit.other
    if picked is None:
        raise ValueError("choose the other human in the panel first")
    other = named_person(context, picked.name)
    if other == person:
        raise ValueError(f"{person.name!r} cannot be the other human too: choose another one")
    return other


def target_armature(context: bpy.types.Context, person: str = "") -> bpy.types.Object:
    """The armature of the human named, else the active armature if it has SMPL's joints, else the selected human's.

    Raises ValueError; for an active armature with some of SMPL's bones it names the first one missing.
    """
    if person:
        return named_person(context, person)
    active = context.view_layer.objects.active
    if active is not None and active.type == "ARMATURE":
        missing = [name for name in JOINT_NAMES if name not in active.data.bones]
        if not missing:
            return active
        if len(missing) < len(JOINT_NAMES) or human_of(active) is not None:
            raise ValueError(f"the armature {active.name!r} has no bone {missing[0]!r}: rename it back, or undo")
    return selected_person(context)


def may_have_joints(context: bpy.types.Context) -> bool:
    """Whether there is a human, or an active armature: `target_armature` may still reject it, with a reason."""
    active = context.view_layer.objects.active
    return bool(humans(context.scene)) or (active is not None and active.type == "ARMATURE")


def warn_of_rest(operator: bpy.types.Operator, armature: bpy.types.Object) -> None:
    """Warn where the armature is shown in its rest position."""
    if armature.data.pose_position == "REST":
        operator.report({"WARNING"}, f"{armature.name!r} shows its rest position: switch it to Pose Position.")


class ArmatureOperator(HumanOperator):
    """Base of operators on one armature with SMPL's joints, a human's or another."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        found = may_have_joints(context)
        if not found:
            cls.poll_message_set("There is no human in the scene: add one, or select an armature with SMPL's joints")
        return found

    def person(self, context: bpy.types.Context) -> bpy.types.Object:
        return target_armature(context, self.human)


class WhereTo:
    """Properties of operators that key a motion, with the values of `motion.placing.Placement`."""

    start: bpy.props.IntProperty(name="Start Frame", description="Scene frame of the first pose", default=1)
    root: bpy.props.EnumProperty(
        name="Root Motion",
        description="What happens to the path through space",
        items=[
            ("ORIGIN", "From the Human", "The path begins where the human is"),
            ("KEEP", "As It Is", "The path stays as in the file, maybe metres away"),
            ("PLACE", "In Place", "The human stays in place; only the height of the path is used"),
        ],
    )
    extend: bpy.props.BoolProperty(
        name="Extend Scene",
        description="Move the end of the scene to the end of the motion if it is later",
        default=True,
    )
