"""Operators on the selected human: attachment, merging, density gain."""

from __future__ import annotations

import bpy

from ..formats.requests import VOXEL
from ..jobs.deferred_volumes import deferred_volumes
from ..jobs.export import show, shown
from ..jobs.follow import submit
from ..jobs.merge import MergeFramesJob, MergeJob, Moment
from ..jobs.target import HumanTarget
from ..scene.attachment import (
    attachment_before_merge,
    attachment_of,
    in_viewport,
    set_attachment,
    show_in_viewport,
)
from ..scene.human import armature_of, humans
from ..scene.merged import merged_of, remove_merged
from ..scene.proxy import proxy_of
from .declared import SKIP
from .on_person import OnPerson

ATTACHMENT_ITEMS = (
    ("ARMATURE", "Armature", "Each volume is an object that follows the bones; fast, and the default"),
    ("SURFACE", "Surface", "Volumes are placed on the posed skin in each pose, as in the PrimDiffusion engine"),
    ("MERGED", "Merged", "The merged volume, in the pose it was merged in; far faster in Cycles"),
)
_MOST_FRAMES = 10_000


class PRIMDIFFUSION_OT_set_attachment(OnPerson, bpy.types.Operator):
    """Choose how the selected human's volumes follow the body"""

    bl_idname = "primdiffusion.set_attachment"
    bl_label = "Set Attachment"
    bl_options = {"UNDO"}

    mode: bpy.props.EnumProperty(
        name="Attachment", description="How volumes follow the body", items=ATTACHMENT_ITEMS, default="ARMATURE"
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return next(text for name, _, text in ATTACHMENT_ITEMS if name == properties.mode)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        set_attachment(person, self.mode)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_volumes_in_viewport(OnPerson, bpy.types.Operator):
    """Show or hide the selected human's volumes in viewports; drawn, they take a gigabyte. Renders always have them"""

    bl_idname = "primdiffusion.volumes_in_viewport"
    bl_label = "Volumes in Viewport"
    bl_options = {"UNDO"}

    everyone: bpy.props.BoolProperty(name="All Humans", description="Do it for all humans of the scene", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        visible = not in_viewport(person)
        if visible:
            deferred_volumes.finish()
        for each in humans(context.scene) if self.everyone else [person]:
            what = shown(each)
            show_in_viewport(each, visible)
            if proxy_of(each) is not None:
                show(each, what)
        return {"FINISHED"}


_MERGES = (
    (
        "POSE",
        "Current Pose",
        "Merge the selected human's volumes, in the current pose, into one that Cycles renders much faster",
    ),
    (
        "FRAMES",
        "Frame Range",
        "Merge the human's volumes into one volume for each frame of the scene's range, in the background",
    ),
    ("NOTHING", "Nothing", "Show the human's own volumes again and remove the merged one"),
)


class PRIMDIFFUSION_OT_merge(OnPerson, bpy.types.Operator):
    """Merge the selected human's volumes into one that Cycles renders much faster, or show its own volumes again"""

    bl_idname = "primdiffusion.merge"
    bl_label = "Merge Volumes"

    what: bpy.props.EnumProperty(name="Merge", description="What is merged", items=_MERGES, options=SKIP)
    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Metres. Not given: the panel's",
        min=0.0005,
        default=VOXEL,
        options=SKIP,
    )
    frame_start: bpy.props.IntProperty(name="Start", description="Not given: the scene's", options=SKIP)
    frame_end: bpy.props.IntProperty(name="End", description="Not given: the scene's", options=SKIP)

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return next(text for name, _, text in _MERGES if name == properties.what)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        if self.what == "NOTHING":
            _unmerge(person)
            bpy.ops.ed.undo_push(message="Unmerge")
            return {"FINISHED"}
        given, target = self.properties.is_property_set, HumanTarget.of(person)
        voxel = self.voxel if given("voxel") else context.scene.primdiffusion_merging.voxel
        if self.what == "POSE":
            moment = _moment(person, context.evaluated_depsgraph_get())
            return submit(self, context, MergeJob(target, moment, voxel))
        start, end = (getattr(self if given(name) else context.scene, name) for name in ("frame_start", "frame_end"))
        if not 1 < end - start + 1 <= _MOST_FRAMES:
            raise ValueError(
                f"frames {start} to {end} are no sequence: give a start and a later end, of at most {_MOST_FRAMES}"
            )
        moments = _moments(context, person, range(start, end + 1))
        return submit(self, context, MergeFramesJob(target, moments, start, voxel))


def _unmerge(person: bpy.types.Collection) -> None:
    """Raises ValueError where there is no merged volume."""
    if merged_of(person) is None:
        raise ValueError(f"{person.name!r} has no merged volume")
    if attachment_of(person) == "MERGED":
        set_attachment(person, attachment_before_merge(person))
    remove_merged(person)


def _moment(person: bpy.types.Collection, graph: bpy.types.Depsgraph) -> Moment:
    return Moment.now(person, armature_of(person).evaluated_get(graph))


def _moments(context: bpy.types.Context, person: bpy.types.Collection, frames: range) -> list[Moment]:
    """The human in each frame; the scene is at its own frame again afterwards."""
    scene, now = context.scene, context.scene.frame_current
    moments = []
    try:
        for frame in frames:
            scene.frame_set(frame)
            moments.append(_moment(person, context.evaluated_depsgraph_get()))
    finally:
        scene.frame_set(now)
    return moments
