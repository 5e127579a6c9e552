"""What the Export panel holds."""

from __future__ import annotations

import bpy

from ...formats import requests
from ..translations import CONTEXT

FORMATS = (
    ("GLB", "glTF", "One .glb file: for game engines, web viewers and most other programs"),
    ("FBX", "FBX", "One .fbx file with the texture in it"),
    ("USD", "USD", "A .usd file with its texture beside it, or one .usdz file"),
)
MODEL_ENDINGS = {"GLB": (".glb",), "FBX": (".fbx",), "USD": (".usdc", ".usda", ".usd", ".usdz")}
"""Of files, by the format; the first is the usual one."""
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
        description="Of the mesh proxy, at most",
        default=requests.TRIANGLES,
        min=500,
        max=1_000_000,
    )
    gaussians: bpy.props.IntProperty(
        name="Gaussians",
        description="At most; a person has some 130 thousand that can be seen",
        default=requests.GAUSSIANS,
        min=1000,
        max=1_000_000,
    )
    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Side of the voxels of a VDB sequence: half of it, eight times the memory",
        default=requests.VOXEL,
        min=0.002,
        max=0.05,
        precision=3,
        step=0.1,
        subtype="DISTANCE",
    )
    motion: bpy.props.BoolProperty(
        name="With Motion",
        description="Keep the scene's frames of the person in the .human file; otherwise the person alone",
        default=False,
    )
