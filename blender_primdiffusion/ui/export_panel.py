"""The sidebar panel Export; .human files, imported or dropped onto the 3D view."""

from __future__ import annotations

import bpy

from ..places import backend_is_named
from ..scene.human import proxy_of, selected_person
from ..scene.proxy import is_outdated
from .advanced_panel import draw_representations
from .drawing import SidebarPanel, draw_job, draw_lines, draw_section, property_columns
from .export_operators import OPTIONS
from .menus import draw_samples


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
    except ValueError:
        return
    try:
        proxy = proxy_of(person)
        outdated = proxy is not None and is_outdated(person, proxy)
    except ValueError:
        return
    if proxy is None:
        return
    draw_representations(layout, person)
    layout.operator("primdiffusion.set_representation", text="Remove Mesh Proxy", icon="X").representation = "NO_MESH"
    if outdated:
        draw_lines(layout, "Shape or clothes have changed: add it again", "INFO")


def draw_as_mesh(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """For the selected human: a button that adds a mesh proxy, with its progress; where there is one, what is shown."""
    try:
        person = selected_person(context)
    except ValueError:
        return
    if proxy_of(person) is None:
        draw_job(layout, "add_proxy", "primdiffusion.add_proxy", "OUTLINER_OB_MESH", text="As Mesh")
    else:
        draw_representations(layout, person)


def draw_from_file(layout: bpy.types.UILayout) -> None:
    """Humans from .human files."""
    draw_samples(layout)
    draw_job(layout, "import_human", "primdiffusion.import_human", "IMPORT")


class PRIMDIFFUSION_FH_human(bpy.types.FileHandler):
    """.human files."""

    bl_idname = "PRIMDIFFUSION_FH_human"
    bl_label = "Human"
    bl_import_operator = "primdiffusion.import_human"
    bl_file_extensions = ".human;.safetensors"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"
