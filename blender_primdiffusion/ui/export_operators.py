"""Export the selected human, and import .human files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..formats import requests
from ..jobs.follow import Reporting, submit
from ..jobs.target import HumanTarget
from ..scene.human import armature_of
from .on_person import PANELS, SKIP, OnPerson
from .translations import CONTEXT


def destination(filepath: str, endings: Sequence[str]) -> Path:
    """The file to write, with the first extension where it has none. Raises ValueError or OSError."""
    if not filepath or filepath.endswith(("/", "\\")):
        raise ValueError("name a file to export to")
    path = Path(bpy.path.abspath(filepath))
    if not path.is_absolute():
        raise ValueError(
            f"{filepath!r} is relative to a .blend that was never saved: save it first, or give an absolute path"
        )
    if not path.suffix:
        path = path.with_suffix(endings[0])
    if path.suffix.lower() not in endings:
        raise ValueError(f"{path.name!r} has another ending than {', '.join(endings)}: rename it, or choose a format")
    if path.is_dir():
        raise ValueError(f"{str(path)!r} is a folder: name a file in it")
    check_writable(path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f"{str(path)!r} is not writable: choose another file")
    return path


def check_writable(folder: Path) -> None:
    """Raises FileNotFoundError or PermissionError for a folder that cannot be written to."""
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {str(folder)!r}: make it first, or choose another")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"the folder {str(folder)!r} is not writable: choose another")


FORMATS = (
    ("GLB", "glTF", "One .glb file: for game engines, web viewers and most other programs"),
    ("FBX", "FBX", "One .fbx file with the texture in it"),
    ("USD", "USD", "A .usd file with its texture beside it, or one .usdz file"),
)
MODEL_ENDINGS = {"GLB": (".glb",), "FBX": (".fbx",), "USD": (".usdc", ".usda", ".usd", ".usdz")}
"""File extensions by format; the first is the default."""
HUMAN_ENDINGS = (".human", ".safetensors")
SHOWN = (
    ("VOLUMES", "Volumes", "Show and render the volumes; the mesh proxy is hidden"),
    ("VIEWPORT", "Mesh in Viewport", "Show the mesh proxy while working, and render the volumes"),
    ("MESH", "Mesh", "Show and render the mesh proxy, in any engine; the volumes are hidden"),
)


class PRIMDIFFUSION_PG_export(bpy.types.PropertyGroup):
    """Of a scene."""

    format: bpy.props.EnumProperty(name="Format", description="What Export Mesh writes", items=FORMATS)
    animation: bpy.props.BoolProperty(
        name="Animation",
        description="The scene's frames, constraints and layers included; otherwise the current pose",
        default=True,
    )
    texture_px: bpy.props.EnumProperty(
        name="Texture",
        description="Pixels a side of the mesh proxy's texture",
        items=[(str(px), f"{px} px", "") for px in (512, 1024, 2048, 4096)],
        default=str(requests.TEXTURE_SIZE),
    )
    triangles: bpy.props.IntProperty(
        name="Triangles",
        translation_context=CONTEXT,
        description="Maximum number of triangles of the mesh proxy",
        default=requests.TRIANGLES,
        min=500,
        max=1_000_000,
    )
    gaussians: bpy.props.IntProperty(
        name="Gaussians",
        description="Maximum number of Gaussians; about 130,000 of a human are visible",
        default=requests.GAUSSIANS,
        min=1000,
        max=1_000_000,
    )
    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Voxel size of the VDB sequence: half the size takes eight times the memory",
        default=requests.VOXEL,
        min=0.002,
        max=0.05,
        precision=3,
        step=0.1,
        subtype="DISTANCE",
    )
    motion: bpy.props.BoolProperty(
        name="With Motion",
        description="Include the motion of the scene's frame range in the .human file; otherwise only the human",
        default=False,
    )
    compact: bpy.props.BoolProperty(
        name="Compact",
        description="Store colours and densities of the .human file in 8 bits: 2 MB instead of 8, without visible loss",
        default=False,
    )


class _Export(OnPerson):
    """Base of the exports; not redoable, since a redo slider must not start the job again."""

    def chosen(self, context: bpy.types.Context, name: str):
        """The operator's property if set, else the panel's."""
        given = self.properties.is_property_set(name)
        return getattr(self if given else context.scene.primdiffusion_export, name)


class _ToFile(_Export):
    """Base of the exports to one file."""

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options=SKIP)
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        try:
            person = self.person(context)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not self.filepath:
            self.filepath = bpy.path.clean_name(person.name) + self.endings(context)[0]
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context: bpy.types.Context) -> bool:
        endings = self.endings(context)
        if self.filepath and Path(self.filepath).suffix.lower() not in endings:
            self.filepath = bpy.path.ensure_ext(self.filepath, endings[0])
            return True
        return False


class PRIMDIFFUSION_OT_export_mesh(_ToFile, bpy.types.Operator):
    """Export the selected human as a textured mesh with its armature"""

    bl_idname = "primdiffusion.export_mesh"
    bl_label = "Export Mesh"

    format: bpy.props.EnumProperty(name="Format", items=FORMATS, description=PANELS, options=SKIP)
    animation: bpy.props.BoolProperty(name="Animation", description=PANELS, options=SKIP)
    texture_px: bpy.props.IntProperty(name="Texture", description=PANELS, min=64, max=8192, options=SKIP)
    triangles: bpy.props.IntProperty(
        name="Triangles", translation_context=CONTEXT, description=PANELS, min=500, max=1_000_000, options=SKIP
    )

    def endings(self, context: bpy.types.Context) -> tuple[str, ...]:
        return MODEL_ENDINGS[self.chosen(context, "format")]

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """Without a format, the file's extension decides."""
        # needs numpy
        from ..jobs.export import ExportMeshJob, scene_frames
        from ..scene.export_model import check_ready

        kind = self.chosen(context, "format")
        if not self.properties.is_property_set("format"):
            ending = Path(self.filepath).suffix.lower()
            kind = next((name for name, endings in MODEL_ENDINGS.items() if ending in endings), kind)
        path = destination(self.filepath, MODEL_ENDINGS[kind])
        target, frames = HumanTarget.of(person), scene_frames(context.scene, self.chosen(context, "animation"))
        check_ready(armature_of(person))
        px, triangles = int(self.chosen(context, "texture_px")), self.chosen(context, "triangles")
        return submit(self, context, ExportMeshJob(target, px, triangles, path, kind, frames))


class PRIMDIFFUSION_OT_add_proxy(_Export, bpy.types.Operator):
    """Add a textured mesh of the selected human that follows the armature: fast in any viewport and engine"""

    bl_idname = "primdiffusion.add_proxy"
    bl_label = "Add Mesh Proxy"

    texture_px: bpy.props.IntProperty(name="Texture", description=PANELS, min=64, max=8192, options=SKIP)
    triangles: bpy.props.IntProperty(
        name="Triangles", translation_context=CONTEXT, description=PANELS, min=500, max=1_000_000, options=SKIP
    )

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        # needs numpy
        from ..jobs.export import AddProxyJob
        from ..scene.export_model import check_ready

        target = HumanTarget.of(person)
        check_ready(armature_of(person))
        px, triangles = int(self.chosen(context, "texture_px")), self.chosen(context, "triangles")
        return submit(self, context, AddProxyJob(target, px, triangles))


class PRIMDIFFUSION_OT_show_proxy(_Export, bpy.types.Operator):
    """Choose how the selected human is shown: as volumes or as the mesh proxy"""

    bl_idname = "primdiffusion.show_proxy"
    bl_label = "Show Volumes or Mesh"
    bl_options = {"UNDO"}

    shown: bpy.props.EnumProperty(
        name="Show", translation_context=CONTEXT, description="How the human is shown", items=SHOWN
    )

    def run(self, _context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.export import show  # needs numpy

        show(person, self.shown)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_remove_proxy(_Export, bpy.types.Operator):
    """Remove the mesh proxy of the selected human and show the volumes"""

    bl_idname = "primdiffusion.remove_proxy"
    bl_label = "Remove Mesh Proxy"
    bl_options = {"UNDO"}

    def run(self, _context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        # needs numpy
        from ..jobs.export import show
        from ..scene.proxy import proxy_of, remove_proxy

        show(person, "VOLUMES")
        remove_proxy(proxy_of(person))
        return {"FINISHED"}


class PRIMDIFFUSION_OT_export_gaussians(_ToFile, bpy.types.Operator):
    """Export the selected human in the current pose as 3D Gaussians for splat viewers"""

    bl_idname = "primdiffusion.export_gaussians"
    bl_label = "Export Gaussians"

    gaussians: bpy.props.IntProperty(name="Gaussians", description=PANELS, min=1, options=SKIP)

    def endings(self, _context: bpy.types.Context) -> tuple[str, ...]:
        return (".ply",)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.export import ExportGaussiansJob, posed_now  # needs numpy

        path = destination(self.filepath, self.endings(context))
        job = ExportGaussiansJob(
            HumanTarget.of(person), path, posed_now(context, person), self.chosen(context, "gaussians")
        )
        return submit(self, context, job)


class PRIMDIFFUSION_OT_export_vdb_sequence(_Export, bpy.types.Operator):
    """Export the selected human as one volume file for each frame, for any renderer that reads OpenVDB"""

    bl_idname = "primdiffusion.export_vdb_sequence"
    bl_label = "Export VDB Sequence"

    directory: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", options=SKIP)
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    first: bpy.props.IntProperty(name="First Frame", description="Not given: the scene's", options=SKIP)
    last: bpy.props.IntProperty(name="Last Frame", description="Not given: the scene's", options=SKIP)
    voxel: bpy.props.FloatProperty(name="Voxel Size", description=PANELS, min=0.002, max=0.05, options=SKIP)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.export import ExportVdbSequenceJob, posed_frames  # needs numpy

        if not self.directory:
            raise ValueError("name a folder to export to")
        folder = Path(bpy.path.abspath(self.directory))
        check_writable(folder)
        scene, given = context.scene, self.properties.is_property_set
        first = self.first if given("first") else scene.frame_start
        last = self.last if given("last") else scene.frame_end
        if last < first:
            raise ValueError(f"the last frame {last} is before the first, {first}: swap them")
        target, stem = HumanTarget.of(person), bpy.path.clean_name(person.name)
        people = posed_frames(context, person, range(first, last + 1))
        job = ExportVdbSequenceJob(target, folder, stem, people, first, self.chosen(context, "voxel"))
        return submit(self, context, job)


class PRIMDIFFUSION_OT_export_human(_ToFile, bpy.types.Operator):
    """Export the selected human as a .human file that can be dropped into another scene"""

    bl_idname = "primdiffusion.export_human"
    bl_label = "Export Human File"

    motion: bpy.props.BoolProperty(name="With Motion", description=PANELS, options=SKIP)
    compact: bpy.props.BoolProperty(name="Compact", description=PANELS, options=SKIP)

    def endings(self, _context: bpy.types.Context) -> tuple[str, ...]:
        return HUMAN_ENDINGS

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.export import scene_frames, write_human  # needs numpy

        path = destination(self.filepath, HUMAN_ENDINGS)
        frames = scene_frames(context.scene, True) if self.chosen(context, "motion") else None
        write_human(context, person, path, frames, compact=self.chosen(context, "compact"))
        self.report({"INFO"}, f"Exported {person.name} to {path.name}")
        return {"FINISHED"}


class PRIMDIFFUSION_OT_import_human(Reporting, bpy.types.Operator):
    """Add the human of a .human file to the scene"""

    bl_idname = "primdiffusion.import_human"
    bl_label = "Import Human File"

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options=SKIP)
    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{ending}" for ending in HUMAN_ENDINGS), options={"HIDDEN"}
    )
    location: bpy.props.FloatVectorProperty(
        name="Location",
        description="Not given: the world's origin",
        subtype="XYZ",
        options=SKIP,
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Import a dropped file at once; otherwise open the file browser."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> set[str]:
        # needs numpy
        from ..jobs.export import ImportHumanJob
        from ..scene.human_file import motion_in, read_tensors

        path = Path(bpy.path.abspath(self.filepath))
        if not self.filepath or not path.is_file():
            raise FileNotFoundError(f"there is no file {str(path)!r}: choose a .human file")
        motion_in(read_tensors(path), path.name)
        at = tuple(self.location) if self.properties.is_property_set("location") else None
        return submit(self, context, ImportHumanJob(str(path), at))


PROPERTIES = ((bpy.types.Scene, "primdiffusion_export", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_export)),)
