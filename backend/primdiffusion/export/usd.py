"""A mesh proxy as .usdz: one archive of a stage in text, skinned with UsdSkel, and its texture.

https://openusd.org/release/spec_usdz.html: an uncompressed zip, the stage first, each file's bytes at a multiple of 64.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array
from PIL import Image

from primdiffusion.export.proxy import MeshProxy
from primdiffusion.formats.whole_files import written_whole
from primdiffusion.geometry.textured_mesh import vertex_normals
from primdiffusion.people.gltf import Skeleton

STAGE, TEXTURE = "human.usda", "texture.png"
ALIGNMENT = 64
LOCAL_HEADER = 30
"""Bytes of a zip's local header before the file's name and its extra field."""
PADDING_FIELD = 0x1986
"""Identifier of the extra field that USD itself pads with."""
TEMPLATE = """#usda 1.0
(
    customLayerData = {{
        string primdiffusion = {provenance}
    }}
    defaultPrim = "human"
    metersPerUnit = 1
    upAxis = "Y"
)

def SkelRoot "human"
{{
    def Skeleton "skeleton"
    {{
        uniform token[] joints = [{joints}]
        uniform matrix4d[] bindTransforms = [{bind}]
        uniform matrix4d[] restTransforms = [{rest}]
    }}

    def Mesh "mesh" (
        prepend apiSchemas = ["SkelBindingAPI", "MaterialBindingAPI"]
    )
    {{
        uniform token subdivisionScheme = "none"
        float3[] extent = [{extent}]
        int[] faceVertexCounts = [{counts}]
        int[] faceVertexIndices = [{indices}]
        point3f[] points = [{points}]
        normal3f[] normals = [{normals}] (
            interpolation = "vertex"
        )
        texCoord2f[] primvars:st = [{uv}] (
            interpolation = "faceVarying"
        )
        matrix4d primvars:skel:geomBindTransform = {identity}
        int[] primvars:skel:jointIndices = [{joint_indices}] (
            elementSize = {influences}
            interpolation = "vertex"
        )
        float[] primvars:skel:jointWeights = [{joint_weights}] (
            elementSize = {influences}
            interpolation = "vertex"
        )
        rel material:binding = </human/material>
        rel skel:skeleton = </human/skeleton>
    }}

    def Material "material"
    {{
        token outputs:surface.connect = </human/material/surface.outputs:surface>

        def Shader "surface"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </human/material/colour.outputs:rgb>
            float inputs:roughness = 1
            token outputs:surface
        }}

        def Shader "colour"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{texture}@
            token inputs:sourceColorSpace = "sRGB"
            float2 inputs:st.connect = </human/material/uv.outputs:result>
            float3 outputs:rgb
        }}

        def Shader "uv"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}
}}
"""


def write_proxy_usdz(path: str | Path, proxy: MeshProxy, provenance: Mapping[str, Any]) -> None:
    """Write one .usdz: mesh, texture, skin and skeleton; metres, y up, facing z, soles at y = 0.

    Raises OSError.
    """
    picture = io.BytesIO()
    Image.fromarray(proxy.texture).save(picture, format="PNG")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in ((STAGE, stage(proxy.on_floor(), provenance).encode()), (TEXTURE, picture.getvalue())):
            entry = zipfile.ZipInfo(name)
            begins = packed.tell() + LOCAL_HEADER + len(name) + 4  # 4: identifier and length of the extra field
            padding = -begins % ALIGNMENT
            entry.extra = PADDING_FIELD.to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(entry, content)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(packed.getvalue())


def stage(proxy: MeshProxy, provenance: Mapping[str, Any]) -> str:
    """Return the stage as text."""
    (part,) = proxy.mesh().parts
    skeleton = proxy.skeleton
    at = np.asarray(skeleton.positions, np.float64)
    parents = np.asarray(skeleton.parents)
    offsets = at - np.where(parents[:, None] >= 0, at[parents], 0.0)
    return TEMPLATE.format(
        provenance=json.dumps(json.dumps(dict(provenance))),
        joints=", ".join(json.dumps(name) for name in _joint_paths(skeleton)),
        bind=", ".join(map(_translation, at)),
        rest=", ".join(map(_translation, offsets)),
        identity=_translation(np.zeros(3)),
        extent=_tuples(np.stack([proxy.vertices.min(0), proxy.vertices.max(0)]), 6),
        counts=", ".join(["3"] * len(proxy.faces)),
        indices=", ".join(map(str, proxy.faces.ravel().tolist())),
        points=_tuples(proxy.vertices, 6),
        normals=_tuples(vertex_normals(proxy.vertices, proxy.faces), 4),
        uv=_tuples(proxy.corner_uv.reshape(-1, 2), 6),
        influences=part.skin_index.shape[1],
        joint_indices=", ".join(map(str, part.skin_index.ravel().tolist())),
        joint_weights=", ".join(f"{weight:.6f}" for weight in part.skin_weight.ravel().tolist()),
        texture=TEXTURE,
    )


def _joint_paths(skeleton: Skeleton) -> list[str]:
    """Names of joints below those of their parents, as UsdSkel orders them."""
    paths: list[str] = []
    for name, parent in zip(skeleton.names, skeleton.parents, strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return paths


def _translation(offset: Array) -> str:
    """A row-vector matrix, as USD writes them."""
    x, y, z = (f"{value:.6f}" for value in offset)
    return f"((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), ({x}, {y}, {z}, 1))"


def _tuples(rows: Array, digits: int) -> str:
    return ", ".join("(" + ", ".join(f"{value:.{digits}f}" for value in row) + ")" for row in rows.tolist())
