"""Export armature and mesh proxy to other programs by Blender's own exporters, in a temporary scene.

That scene holds nothing else, so the user's selection, modes and visibility stay as they are. Bones that deform nothing
(IK handles) are left out, and their effect is in the joints.
"""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import addon_utils
import bpy

from ..files.regular_files import remove_folder
from ..files.whole_files import replacing
from ..formats.joints import JOINT_NAMES


@dataclasses.dataclass(frozen=True)
class FrameRange:
    """The frames that are exported."""

    first: int
    last: int

    @property
    def animated(self) -> bool:
        """Whether this is more than one pose."""
        return self.last > self.first


def check_ready(armature: bpy.types.Object) -> None:
    """Raises ValueError for an armature that cannot be exported now."""
    if armature.data.is_editmode:
        raise ValueError(f"{armature.name!r} is in Edit Mode: leave it (Tab) to export")
    missing = [name for name in JOINT_NAMES if name not in armature.data.bones]
    if missing:
        raise ValueError(
            f"the armature {armature.name!r} has no bone {missing[0]!r}: give it this name again to export"
        )


def write_model(
    context: bpy.types.Context,
    armature: bpy.types.Object,
    mesh: bpy.types.Object,
    path: Path,
    kind: str,
    frames: FrameRange,
) -> None:
    """Write a file of `kind` (GLB, FBX or USD), which appears whole or not at all.

    USD's textures go into a folder beside the file, except in .usdz. Raises ValueError or RuntimeError where an
    exporter is missing or fails, and OSError.
    """
    check_ready(armature)
    folder = Path(tempfile.mkdtemp(prefix="export_", dir=bpy.app.tempdir or None))
    try:
        with _selected_in_scene(context, armature, mesh, frames) as overrides, context.temp_override(**overrides):
            _EXPORTERS[kind](folder / path.name, frames)
        if not (folder / path.name).is_file():
            raise RuntimeError(f"Blender's exporter wrote no {kind} file: see the console")
        _publish(folder, path)
    finally:
        remove_folder(folder, folder.parent)


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


@contextmanager
def _selected_in_scene(
    context: bpy.types.Context, armature: bpy.types.Object, mesh: bpy.types.Object, frames: FrameRange
) -> Iterator[dict[str, object]]:
    """Context overrides for a temporary scene in which the armature and the mesh are selected."""
    with scene_with_only(context, armature) as scene:
        scene.frame_start, scene.frame_end = frames.first, frames.last
        scene.collection.objects.link(mesh)
        layer = scene.view_layers[0]
        if frames.animated:
            scene.frame_set(frames.first)
        for obj in (armature, mesh):
            obj.select_set(True, view_layer=layer)
        layer.objects.active = armature
        yield {
            "scene": scene, "view_layer": layer, "active_object": armature, "object": armature,
            "selected_objects": [armature, mesh], "collection": scene.collection,
        }  # fmt: skip


def _write_glb(path: Path, frames: FrameRange) -> None:
    with _enabled("io_scene_gltf2", "glTF"):
        _run(
            bpy.ops.export_scene.gltf,
            filepath=str(path),
            export_format="GLB",
            use_selection=True,
            use_active_scene=True,
            export_image_format="AUTO",
            export_animations=frames.animated,
            export_animation_mode="SCENE",
            export_anim_scene_split_object=False,
            export_frame_range=True,
            export_rest_position_armature=frames.animated,
            export_current_frame=True,
            export_influence_nb=4,
            export_def_bones=True,
            export_extras=False,
        )


def _write_fbx(path: Path, frames: FrameRange) -> None:
    with _enabled("io_scene_fbx", "FBX"):
        _run(
            bpy.ops.export_scene.fbx,
            filepath=str(path),
            use_selection=True,
            object_types={"ARMATURE", "MESH"},
            add_leaf_bones=False,
            use_armature_deform_only=True,
            mesh_smooth_type="FACE",
            path_mode="COPY",
            embed_textures=True,
            bake_anim=True,  # of one frame, too: that is how FBX holds a pose
            bake_anim_use_all_actions=False,
            bake_anim_use_nla_strips=False,
            bake_anim_simplify_factor=0.0,
        )


def _write_usd(path: Path, frames: FrameRange) -> None:
    if not bpy.app.build_options.usd:
        raise ValueError("this Blender was built without USD: choose glTF or FBX")
    _run(
        bpy.ops.wm.usd_export,
        filepath=str(path),
        selected_objects_only=True,
        export_animation=frames.animated,
        export_armatures=True,
        only_deform_bones=True,
        export_textures_mode="NEW",
        export_materials=True,
    )


_EXPORTERS: dict[str, Callable[[Path, FrameRange], None]] = {"GLB": _write_glb, "FBX": _write_fbx, "USD": _write_usd}


@contextmanager
def _enabled(module: str, label: str) -> Iterator[None]:
    """Enable Blender's own add-on `module` for the block where the user has disabled it."""
    _, loaded = addon_utils.check(module)
    if not loaded and addon_utils.enable(module, default_set=False) is None:
        raise ValueError(f"Blender's {label} add-on {module!r} cannot be enabled: choose another format")
    try:
        yield
    finally:
        if not loaded:
            addon_utils.disable(module, default_set=False)


def _run(exporter: Callable[..., set[str]], **settings: object) -> None:
    """Run an operator; raises RuntimeError, with Blender's own message, where it fails."""
    if exporter(**settings) != {"FINISHED"}:
        raise RuntimeError("Blender's exporter was cancelled: see the console")


def _publish(folder: Path, path: Path) -> None:
    """Copy the written files to their destination, the main file last. Raises OSError."""
    for source in sorted(folder.rglob("*"), key=lambda source: source == folder / path.name):
        if source.is_dir():
            continue
        with replacing(path.parent / source.relative_to(folder), path.parent) as unfinished:
            shutil.copyfile(source, unfinished)
