"""Fit and rig the pack's meshes on a body, and find the faces that others cover."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import BaseMesh
from primdiffusion.people.mhclo import ObjMesh, Proxy
from primdiffusion.people.texel_map import connected_faces
from primdiffusion.people.wardrobe import SKIRTS

JOINTS = 24
INFLUENCES = 4
"""Joints per vertex."""
DRAPE, LOOSE = 6, 0.6
"""Smoothing iterations of a skirt's weights, and the lower fraction of the skirt that is smoothed."""
OVERLAP = 0.012
"""Overlap of socks with trousers, metres."""


@functools.lru_cache(maxsize=64)
def item_skinning(
    assets: Assets, base: BaseMesh, path: str
) -> tuple[Int[np.ndarray, "V 4"], Float[np.ndarray, "V 4"], Float[np.ndarray, "V 3 3"]]:
    """Joints, weights and rotation of a mesh's vertices, blended from the base mesh; the four strongest joints."""
    proxy, mesh = assets.proxy(path)
    dense = np.zeros((len(base.template), JOINTS))
    np.add.at(dense, (np.arange(len(dense))[:, None], base.joint_index), base.joint_weight)
    blended = np.maximum(proxy.blend(dense), 0)
    if path in SKIRTS:
        blended = _draped(blended, mesh, SKIRTS[path])
    turn = np.einsum("vj,jab->vab", blended / blended.sum(1, keepdims=True), base.rest_from_native)
    index = np.argsort(-blended, axis=1, kind="stable")[:, :INFLUENCES]
    weight = np.take_along_axis(blended, index, axis=1)
    return index, weight / weight.sum(1, keepdims=True), turn


def _draped(weight: Float[np.ndarray, "V J"], mesh: ObjMesh, pieces: tuple[int, ...]) -> Float[np.ndarray, "V J"]:
    """Smooth a skirt's weights along the cloth: each half follows one thigh, and the middle would tear."""
    skirt = mesh.faces[np.isin(connected_faces(mesh.faces, len(weight)), pieces)]
    height = mesh.vertices[skirt, 1]
    edges = np.unique(np.sort(skirt[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    loose = mesh.vertices[:, 1:2] < height.min() + LOOSE * np.ptp(height)
    both = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(both[:, 0], minlength=len(weight))[:, None]
    for _ in range(DRAPE):
        around = np.zeros_like(weight)
        np.add.at(around, both[:, 0], weight[both[:, 1]])
        weight = np.where(loose & (count > 0), 0.5 * weight + 0.5 * around / np.maximum(count, 1), weight)
    return weight


def fit_item(
    assets: Assets, base: BaseMesh, path: str, base_vertices: Float[np.ndarray, "B 3"]
) -> Float[np.ndarray, "V 3"]:
    """Fit a mesh to a body in the base's rest pose, metres."""
    return assets.proxy(path)[0].fit(base_vertices, item_skinning(assets, base, path)[2])


def under_hat(
    hat: Float[np.ndarray, "H 3"], hair: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> np.ndarray:
    """Find the hair faces under a hat ([F] bool): those whose centre is above the plane of its brim.

    The brim is the part farthest from the hat's centre; its plane is fitted, because hats are tilted.
    """
    middle = hat.mean(axis=0)
    radius = np.linalg.norm((hat - middle)[:, [0, 2]], axis=1)
    brim = hat[radius > 0.8 * radius.max()]
    design = np.column_stack([brim[:, 0], brim[:, 2], np.ones(len(brim))])
    slope_x, slope_z, height = np.linalg.lstsq(design, brim[:, 1], rcond=None)[0]
    centre = hair[faces].mean(axis=1)
    return centre[:, 1] > slope_x * centre[:, 0] + slope_z * centre[:, 2] + height


def under_hem(
    outfit: Float[np.ndarray, "O 3"], socks: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> np.ndarray:
    """Find the sock faces under trousers ([F] bool): those above the outfit's lowest point. Skirts cover none."""
    return socks[faces].mean(axis=1)[:, 1] > outfit[:, 1].min() + OVERLAP


def shown_faces(
    base: BaseMesh, proxies: dict[str, tuple[Proxy, Int[np.ndarray, "F 3"]]], covered: Bool[np.ndarray, " B"]
) -> dict[str, np.ndarray]:
    """Find the visible faces of the body ("body") and of every proxy: [F] bool by name.

    From the outermost proxy inwards, each hides the base vertices it lists, on the body and on proxies below. A face is
    hidden if all its vertices are, so that a rim remains under the hem. `covered` vertices of the body are hidden too.
    """
    hidden = np.zeros(len(base.template), bool)
    shown: dict[str, np.ndarray] = {}
    for name, (proxy, faces) in sorted(proxies.items(), key=lambda item: -item[1][0].z_depth):
        shown[name] = ~proxy.hidden_by(hidden)[faces].all(axis=1)
        hidden[proxy.delete_vertices] = True
    shown["body"] = ~(hidden | covered)[base.faces].all(axis=1)
    return shown
