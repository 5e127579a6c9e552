"""The sidebar panel Export: 3D View > N > PrimDiffusion."""

from __future__ import annotations

import bpy

from ..jobs.drawing import draw_job, draw_lines
from ..jobs.target import selected_person
from ..manual import draw_manual_button


class _InSidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012


class PRIMDIFFUSION_PT_export(_InSidebar, bpy.types.Panel):
    """Files of people, out and in."""

    bl_label = "Export"
    bl_order = 6

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual."""
        draw_manual_button(self.layout, "export")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout, settings = _prepared(self.layout), context.scene.primdiffusion_export
        layout.prop(settings, "motion")
        layout.operator("primdiffusion.export_human", icon="EXPORT")
        draw_job(layout, "import_human", "primdiffusion.import_human", "IMPORT")


class PRIMDIFFUSION_PT_export_mesh(_InSidebar, bpy.types.Panel):
    """The mesh proxy as a file, or in the scene."""

    bl_label = "Textured Mesh"
    bl_parent_id = "PRIMDIFFUSION_PT_export"

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout, settings = _prepared(self.layout), context.scene.primdiffusion_export
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
        from ...scene.proxy import is_outdated, proxy_of
        from ...scene.shape import betas_of
        from .showing import shown

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


class PRIMDIFFUSION_PT_export_volumes(_InSidebar, bpy.types.Panel):
    """Gaussians and VDB sequences."""

    bl_label = "Gaussians and Volumes"
    bl_parent_id = "PRIMDIFFUSION_PT_export"

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout, settings = _prepared(self.layout), context.scene.primdiffusion_export
        layout.prop(settings, "gaussians")
        draw_job(layout, "export_gaussians", "primdiffusion.export_gaussians", "POINTCLOUD_DATA")
        layout.separator()
        layout.prop(settings, "voxel")
        draw_job(layout, "export_vdb_sequence", "primdiffusion.export_vdb_sequence", "VOLUME_DATA")


_LABELS = {"VOLUMES": "Show Volumes", "VIEWPORT": "Show Mesh in Viewport", "MESH": "Show Mesh"}


def _prepared(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    layout.use_property_split = True
    layout.use_property_decorate = False
    return layout
