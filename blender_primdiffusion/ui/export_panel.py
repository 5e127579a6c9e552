"""The sidebar panels Export and From File, and .human files dropped onto the 3D view."""

from __future__ import annotations

import bpy

from ..jobs.target import selected_person
from ..places import INSTALLS_BACKEND
from . import gallery
from .drawing import OUTPUT, SidebarPanel, draw_job, draw_lines, property_columns


class PRIMDIFFUSION_PT_export(SidebarPanel, bpy.types.Panel):
    """The selected human as a .human file."""

    bl_label = "Export"
    bl_category = OUTPUT
    bl_order = 6
    manual_page = "export"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_export
        layout.prop(settings, "motion")
        layout.prop(settings, "compact")
        layout.operator("primdiffusion.export_human", icon="EXPORT")


class PRIMDIFFUSION_PT_from_file(SidebarPanel, bpy.types.Panel):
    """Humans from .human files."""

    bl_label = "From File"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"} if INSTALLS_BACKEND else set()
    manual_page, manual_section = "export", "human-files"

    def draw(self, _context: bpy.types.Context) -> None:
        gallery.draw_samples(self.layout)
        draw_job(self.layout, "import_human", "primdiffusion.import_human", "IMPORT")


class PRIMDIFFUSION_PT_export_mesh(SidebarPanel, bpy.types.Panel):
    """The mesh proxy as a file, or in the scene."""

    bl_label = "Textured Mesh"
    bl_category = OUTPUT
    bl_parent_id = "PRIMDIFFUSION_PT_export"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_export
        for name in ("texture_px", "triangles", "format", "animation"):
            layout.prop(settings, name)
        draw_job(layout, "export_mesh", "primdiffusion.export_mesh", "EXPORT")
        layout.separator()
        draw_job(layout, "add_proxy", "primdiffusion.add_proxy", "OUTLINER_OB_MESH")
        self._draw_proxy(context)

    def _draw_proxy(self, context: bpy.types.Context) -> None:
        try:
            person = selected_person(context)
        except ValueError:
            return
        # needs numpy
        from ..jobs.export import shown
        from ..scene.proxy import is_outdated, proxy_of
        from ..scene.shape import betas_of

        try:
            proxy = proxy_of(person)
            outdated = proxy is not None and is_outdated(person, proxy, betas_of(person))
        except ValueError:
            return
        if proxy is None:
            return
        row = self.layout.row(align=True)
        row.operator_menu_enum("primdiffusion.show_proxy", "shown", text=_LABELS[shown(person)], icon="HIDE_OFF")
        row.operator("primdiffusion.remove_proxy", text="", icon="X")
        if outdated:
            draw_lines(self.layout, "Shape or clothes have changed: add it again", "INFO")


class PRIMDIFFUSION_PT_export_volumes(SidebarPanel, bpy.types.Panel):
    """Gaussians and VDB sequences."""

    bl_label = "Gaussians and Volumes"
    bl_category = OUTPUT
    bl_parent_id = "PRIMDIFFUSION_PT_export"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_export
        layout.prop(settings, "gaussians")
        draw_job(layout, "export_gaussians", "primdiffusion.export_gaussians", "POINTCLOUD_DATA")
        layout.separator()
        layout.prop(settings, "voxel")
        draw_job(layout, "export_vdb_sequence", "primdiffusion.export_vdb_sequence", "VOLUME_DATA")


_LABELS = {"VOLUMES": "Show Volumes", "VIEWPORT": "Show Mesh in Viewport", "MESH": "Show Mesh"}


class PRIMDIFFUSION_FH_human(bpy.types.FileHandler):
    """.human files."""

    bl_idname = "PRIMDIFFUSION_FH_human"
    bl_label = "Human"
    bl_import_operator = "primdiffusion.import_human"
    bl_file_extensions = ".human;.safetensors"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"
