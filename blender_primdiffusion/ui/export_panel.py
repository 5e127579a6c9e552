"""The sidebar panel Export, with its settings and operators; .human files, imported or dropped onto the 3D view."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..backend.requests import sentence
from ..formats.requests import GaussiansRequest, ProxyRequest
from ..jobs.export import (
    AddProxyJob,
    ExportGaussiansJob,
    ExportMeshJob,
    posed_frames,
    scene_frames,
    write_human,
)
from ..jobs.follow import Reporting, submit
from ..jobs.generate import add_human
from ..jobs.queue import Job
from ..places import backend_is_named
from ..scene.armature import check_joints
from ..scene.build import build_human
from ..scene.human import HumanTarget, proxy_of, selected_person
from ..scene.human_file import CHOOSE_ANOTHER
from ..scene.proxy import is_outdated
from .advanced_panel import draw_representations
from .declared import SKIP, declared
from .drawing import SidebarPanel, draw_job, draw_lines, draw_section, property_columns
from .menus import FOLDER, draw_samples
from .on_person import HumanOperator

_SAMPLE = "Add a human that comes with the extension to the scene; its data are in the public domain (CC0)"


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
    ("HUMAN", "Human File", "A .human file, which can be dropped into another scene", 3),
    ("GLB", "glTF", "A textured mesh in one .glb file: for game engines, web viewers and most other programs", 0),
    ("FBX", "FBX", "A textured mesh in one .fbx file", 1),
    ("PLY", "Gaussians", "3D Gaussians of the current pose in a .ply file, for splat viewers", 4),
)
ENDINGS = {
    "HUMAN": (".human", ".safetensors"),
    "GLB": (".glb",),
    "FBX": (".fbx",),
    "PLY": (".ply",),
}
"""File extensions by format; the first is the default."""
_OF_MESHES = ("texture_px", "triangles", "animation")
OPTIONS = {
    "HUMAN": (),
    "GLB": _OF_MESHES,
    "FBX": _OF_MESHES,
    "PLY": ("gaussians",),
}
"""Settings of each format."""


class PRIMDIFFUSION_PG_export(bpy.types.PropertyGroup):
    """Export settings of a scene."""

    __slots__ = ()
    format: bpy.props.EnumProperty(name="Format", description="What Export writes", items=FORMATS, default="HUMAN")
    animation: bpy.props.BoolProperty(
        name="Animation",
        description="The scene's frames, constraints and layers included; otherwise the current pose",
        default=True,
    )
    texture_px: bpy.props.EnumProperty(
        name="Texture",
        description="Texture resolution in pixels",
        items=[(str(px), f"{px} px", "") for px in (512, 1024, 2048, 4096)],
        default=str(ProxyRequest.texture_px),
    )
    triangles: declared(ProxyRequest, "triangles")
    gaussians: declared(GaussiansRequest, "limit", name="Gaussians")


class PRIMDIFFUSION_OT_export(HumanOperator, bpy.types.Operator):
    """Export the selected human: for another scene, as a textured mesh, as Gaussians"""

    bl_idname = "primdiffusion.export"
    bl_label = "Export Human"

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options=SKIP)
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Open the file browser with the panel's format."""
        try:
            person = self.person(context)
        except ValueError as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        if not self.filepath:
            ending = ENDINGS[context.scene.primdiffusion_export.format][0]
            self.filepath = bpy.path.clean_name(person.name) + ending
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context: bpy.types.Context) -> bool:
        """The file browser: another format changes the file's extension."""
        endings = ENDINGS[context.scene.primdiffusion_export.format]
        name, ending = os.path.splitext(self.filepath)
        if not name or ending.lower() in endings:
            return False
        known = any(ending.lower() in each for each in ENDINGS.values())
        self.filepath = (name if known else self.filepath) + endings[0]
        return True

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_export
        for name in ("format", *OPTIONS[settings.format]):
            layout.prop(settings, name)

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        kinds = {ending: kind for kind, endings in ENDINGS.items() for ending in endings}
        chosen = context.scene.primdiffusion_export.format
        path = destination(self.filepath, sorted(kinds, key=lambda ending: kinds[ending] != chosen))
        kind = kinds[path.suffix.lower()]
        if kind == "HUMAN":
            write_human(person, path)
            self.report({"INFO"}, f"Exported {person.name} to {path.name}.")
            return {"FINISHED"}
        return submit(self, context, self._job(context, person, kind, path))

    def _job(self, context: bpy.types.Context, person: bpy.types.Object, kind: str, path: Path) -> Job:
        """What writes a mesh or Gaussians. Raises ValueError."""
        target, scene, settings = HumanTarget.of(person), context.scene, context.scene.primdiffusion_export
        if kind == "PLY":
            (now,) = posed_frames(context, person, [scene.frame_current])
            return ExportGaussiansJob(target, path, now, settings.gaussians)
        check_joints(person)
        frames = scene_frames(scene, settings.animation)
        return ExportMeshJob(target, int(settings.texture_px), settings.triangles, path, kind, frames)


class PRIMDIFFUSION_OT_add_proxy(HumanOperator, bpy.types.Operator):
    """Add a textured mesh of the selected human that follows the armature: fast in any viewport and engine"""

    bl_idname = "primdiffusion.add_proxy"
    bl_label = "Add Mesh Proxy"

    def run(self, context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        target, settings = HumanTarget.of(person), context.scene.primdiffusion_export
        check_joints(person)
        return submit(self, context, AddProxyJob(target, int(settings.texture_px), settings.triangles))


class PRIMDIFFUSION_OT_import_human(Reporting, bpy.types.Operator):
    """Add the human of a .human file to the scene"""

    bl_idname = "primdiffusion.import_human"
    bl_label = "Import Human File"
    bl_options = {"UNDO"}

    filepath: bpy.props.StringProperty(name="File", subtype="FILE_PATH", options=SKIP)
    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{ending}" for ending in ENDINGS["HUMAN"]), options={"HIDDEN"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return _SAMPLE if Path(properties.filepath).parent == FOLDER else str(cls.__doc__)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Import a dropped file, or a sample, at once; otherwise open the file browser."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.abspath(self.filepath))
        if not self.filepath or not path.exists():
            raise FileNotFoundError(f"there is no file {str(path)!r}: choose a .human file")
        if context.mode.startswith(("EDIT", "PARTICLE")):
            bpy.ops.object.mode_set(mode="OBJECT")
        name = path.name.removesuffix(".safetensors").removesuffix(".human") or "Human"
        add_human(context, build_human(context, path, name, CHOOSE_ANOTHER))
        return {"FINISHED"}


class PRIMDIFFUSION_PT_export(SidebarPanel, bpy.types.Panel):
    """The selected human as a file, as a mesh proxy."""

    bl_label = "Export"
    bl_order = 3
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "export"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_export
        kind = settings.format if backend_is_named() else "HUMAN"
        if backend_is_named():
            layout.prop(settings, "format")
        for name in OPTIONS[kind]:
            layout.prop(settings, name)
        if kind == "HUMAN":
            layout.operator("primdiffusion.export", icon="EXPORT")
        else:
            draw_job(layout, "export_gaussians" if kind == "PLY" else "export_mesh", "primdiffusion.export", "EXPORT")
        if not backend_is_named():
            return
        if (body := draw_section(layout, "proxy", text="Mesh Proxy", page="export", section="mesh-proxy")) is not None:
            _draw_proxy(body, context)


def _draw_proxy(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """The mesh in the scene."""
    settings = context.scene.primdiffusion_export
    layout.prop(settings, "texture_px")
    layout.prop(settings, "triangles")
    draw_job(layout, "add_proxy", "primdiffusion.add_proxy", "OUTLINER_OB_MESH")
    try:
        person = selected_person(context)
        proxy = proxy_of(person)
        outdated = proxy is not None and is_outdated(person, proxy)
    except ValueError:
        return
    if proxy is None:
        return
    draw_representations(layout, person)
    layout.operator("primdiffusion.set_representation", text="Remove Mesh Proxy", icon="X").representation = "NO_MESH"
    if outdated:
        draw_lines(layout, "Shape or clothes have changed: add it again.", "INFO")


def draw_from_file(layout: bpy.types.UILayout) -> None:
    """Humans from .human files."""
    draw_samples(layout)
    layout.operator("primdiffusion.import_human", icon="IMPORT")


class PRIMDIFFUSION_FH_human(bpy.types.FileHandler):
    """.human files."""

    bl_idname = "PRIMDIFFUSION_FH_human"
    bl_label = "Human"
    bl_import_operator = "primdiffusion.import_human"
    bl_file_extensions = ".human;.safetensors"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


PROPERTIES = ((bpy.types.Scene, "primdiffusion_export", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_export)),)
