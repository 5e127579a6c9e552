"""People as files for other programs, and people from files."""

from __future__ import annotations

import bpy

from ..jobs.work import register_kind, unregister_kind
from . import file_handler, operators, panel, settings

CLASSES = (
    settings.PRIMDIFFUSION_PG_export,
    *operators.CLASSES,
    panel.PRIMDIFFUSION_PT_export,
    panel.PRIMDIFFUSION_PT_export_mesh,
    panel.PRIMDIFFUSION_PT_export_volumes,
    file_handler.PRIMDIFFUSION_FH_human,
)
WORKS = {
    "export_mesh": "mesh_work:ExportMeshWork",
    "add_proxy": "mesh_work:AddProxyWork",
    "export_gaussians": "person_work:ExportGaussiansWork",
    "export_vdb_sequence": "person_work:ExportVdbSequenceWork",
    "import_human": "person_work:ImportHumanWork",
}
"""By kind."""


def register() -> None:
    """Make the room known to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.primdiffusion_export = bpy.props.PointerProperty(type=settings.PRIMDIFFUSION_PG_export)
    for kind, work in WORKS.items():
        register_kind(kind, f"{__name__}.{work}")


def unregister() -> None:
    """Undo `register`."""
    for kind in WORKS:
        unregister_kind(kind)
    del bpy.types.Scene.primdiffusion_export
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
