"""An armature's action: its curves and frames, and what it shows on each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy


def action_curves(armature: bpy.types.Object) -> bpy.types.bpy_prop_collection | None:
    """The curves in the armature's slot of its action, if any."""
    animation = armature.animation_data
    if animation is None or animation.action is None or animation.action_slot is None:
        return None
    for layer in animation.action.layers:
        for strip in layer.strips:
            bag = strip.channelbag(animation.action_slot)
            if bag is not None:
                return bag.fcurves
    return None


def new_action(armature: bpy.types.Object, name: str) -> bpy.types.Action:
    """Give the armature a new action with an empty layer for its pose."""
    action = bpy.data.actions.new(name)
    slot = action.slots.new(id_type="OBJECT", name=armature.name)
    action.layers.new("Pose").strips.new(type="KEYFRAME").channelbag(slot, ensure=True)
    animation = armature.animation_data_create()
    animation.action = action
    animation.action_slot = slot
    return action


def own_curves(armature: bpy.types.Object) -> bpy.types.bpy_prop_collection:
    """The curves of an action of the armature's own: a copy where the action is linked or used elsewhere too, new where
    there is none."""
    curves = action_curves(armature)
    if curves is None:
        new_action(armature, armature.name)
        return action_curves(armature)
    animation = armature.animation_data
    action, slot = animation.action, animation.action_slot
    if action.library is not None or action.users - action.use_fake_user > 1:
        animation.action = action.copy()
        animation.action_slot = animation.action.slots[slot.identifier]
    return action_curves(armature)


def frames_in_use(armature: bpy.types.Object) -> range:
    """Whole frames from the first to the last key of the pose or strip of the armature; empty where it has none."""
    animation = armature.animation_data
    if animation is None:
        return range(0)
    curves = [curve for curve in action_curves(armature) or () if curve.data_path.startswith("pose.bones")]
    times = [point.co[0] for curve in curves for point in (*curve.keyframe_points[:1], *curve.keyframe_points[-1:])]
    strips = [strip for track in animation.nla_tracks if not track.mute for strip in track.strips if not strip.mute]
    times += [time for strip in strips for time in (strip.frame_start, strip.frame_end)]
    return range(math.floor(min(times)), math.ceil(max(times)) + 1) if times else range(0)


@contextmanager
def scene_with_only(context: bpy.types.Context, armature: bpy.types.Object) -> Iterator[bpy.types.Scene]:
    """A temporary scene with only the armature, at the current frame: with volumes, evaluation takes far longer.

    An armature that is hidden or shown in rest position is posed meanwhile.
    """
    source = context.scene
    scene = bpy.data.scenes.new(armature.name)
    before = armature.hide_viewport, armature.data.pose_position
    try:
        armature.hide_viewport, armature.data.pose_position = False, "POSE"
        for name in ("fps", "fps_base"):
            setattr(scene.render, name, getattr(source.render, name))
        scene.unit_settings.scale_length = source.unit_settings.scale_length
        scene.collection.objects.link(armature)
        scene.frame_set(source.frame_current)
        yield scene
    finally:
        armature.hide_viewport, armature.data.pose_position = before
        bpy.data.scenes.remove(scene)


def posed_on(
    context: bpy.types.Context, armature: bpy.types.Object, frames: Iterable[int]
) -> Iterator[bpy.types.Object]:
    """The evaluated armature on each frame, valid until the next one: see `scene_with_only`."""
    with scene_with_only(context, armature) as scene:
        for frame in frames:
            if frame != scene.frame_current:
                scene.frame_set(frame)
            yield armature.evaluated_get(scene.view_layers[0].depsgraph)
