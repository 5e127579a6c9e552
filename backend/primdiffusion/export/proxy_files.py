"""Write mesh proxies: glTF and OBJ for other programs, npz and PNG for Blender."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from primdiffusion.export.proxy import MeshProxy
from primdiffusion.geometry.textured_mesh import vertex_normals
from primdiffusion.people.gltf import glb
from primdiffusion.staging import staged, written_whole

FORMAT_VERSION = 1
ARRAYS, TEXTURE = "proxy.npz", "proxy.png"


def write_proxy_glb(path: str | Path, proxy: MeshProxy, provenance: Mapping[str, Any]) -> None:
    """Write one .glb: mesh, texture, skin and skeleton; y up, facing z, as glTF requires. Raises OSError."""
    with written_whole(path) as unfinished:
        unfinished.write_bytes(glb(proxy.mesh(), proxy.skeleton, {"primdiffusion": dict(provenance)}))


def write_proxy_obj(path: str | Path, proxy: MeshProxy) -> None:
    """Write an .obj, its .mtl and .png, all or none; OBJ has no skinning. Raises OSError."""
    path = Path(path)
    name = path.stem
    normals = vertex_normals(proxy.vertices, proxy.faces)
    lines = [f"mtllib {name}.mtl", "usemtl person"]
    lines += ["v {:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in proxy.vertices]
    lines += ["vt {:.6f} {:.6f}".format(*corner) for corner in proxy.corner_uv.reshape(-1, 2)]
    lines += ["vn {:.4f} {:.4f} {:.4f}".format(*normal) for normal in normals]
    coordinate = np.arange(1, proxy.faces.size + 1).reshape(-1, 3)
    for face, uv in zip((proxy.faces + 1).tolist(), coordinate.tolist(), strict=True):
        lines.append("f " + " ".join(f"{v}/{t}/{v}" for v, t in zip(face, uv, strict=True)))
    with staged(path.parent) as folder:
        (folder / path.name).write_text("\n".join(lines) + "\n", encoding="utf-8")
        material = f"newmtl person\nKd 1 1 1\nKs 0 0 0\nmap_Kd {name}.png\n"
        (folder / f"{name}.mtl").write_text(material, encoding="utf-8")
        Image.fromarray(proxy.texture).save(folder / f"{name}.png")


def write_proxy_arrays(folder: Path, proxy: MeshProxy) -> None:
    """Write ARRAYS and TEXTURE for Blender.

    vertices [V,3], faces [F,3], uv_corner [F,3,2] (v up), skin_weights [V,24], joints [24,3], joint_names [24]; metres,
    y up, facing z. Raises OSError.
    """
    np.savez(
        folder / ARRAYS,
        format_version=np.int64(FORMAT_VERSION),
        joint_names=np.array(proxy.skeleton.names),
        joints=np.asarray(proxy.skeleton.positions, np.float64),
        vertices=proxy.vertices,
        faces=proxy.faces.astype(np.int32),
        uv_corner=proxy.corner_uv,
        skin_weights=proxy.skin_weights,
    )
    Image.fromarray(proxy.texture).save(folder / TEXTURE)
