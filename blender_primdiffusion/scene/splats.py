"""A human as Gaussian splats, which Blender 5.3 and newer draw in every mode and engine: one for each visible voxel.

The splats are one point cloud, a child of the armature. Each has a place in its cell, the frame of a primitive; the
node group, one for all humans, takes the cells from the skinned body, so that Blender's own skinning moves the splats.
"""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
from numpy.typing import NDArray

from .cells import NodeGroup, add_nodes, cell_mesh, shared_group
from .human import body_of, link_part, own_data, parts_of, session_file
from .human_file import RestHuman, read_human
from .shape import betas_of, generated_betas
from .volumes import WINDOW_EXPONENT

SPLATS_MARK, CELLS_MARK = "primdiffusion_splats", "primdiffusion_cells"
"""Custom properties of the objects of a human that hold its splats, and the cells on which these lie."""

SPLATS_AVAILABLE = bpy.app.version >= (5, 3)
"""Whether this Blender has Gaussian splats."""
WIDTH = (0.44, 0.44, 0.375)
"""Standard deviations along T, B, N, in voxel spacings; the trilinear kernel's own is .408."""
GAIN = 2.1
"""Optical depth of a splat relative to its voxel's opacity. Splats composite as 1 - product(1 - a), while the marcher
adds opacities until 1 and so occludes sooner. GAIN and WIDTH are least squares of pictures of four people."""
COVERED = 1.0
"""Voxels below others of their cell whose opacities add up to this are left out: the marcher does not reach them."""
FAINTEST = 0.02
"""Opacity below which a splat is left out."""
LEAST = 0.004
"""Opacity of a voxel along the normal below which it makes none."""
MOST_OPAQUE = 0.995


@dataclasses.dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians in their cells."""

    cell: NDArray[np.int32]
    """The primitive of each [n]."""
    position: NDArray[np.float32]
    """From the primitive's centre along its axes T, B, N [n, 3], metres."""
    scale: NDArray[np.float32]
    """Standard deviations along them [n, 3], metres."""
    opacity: NDArray[np.float32]
    """Along a ray through the centre [n], in (0, 1)."""
    rgb: NDArray[np.float32]
    """Linear [n, 3], in [0, 1]."""


def splats_of(human: RestHuman) -> Splats:
    """The voxels that show, as splats; coarser lattices first (see `_lattice`)."""
    payload = human.payload
    half_extent = human.rest_half_extent * payload.delta_scale
    size = payload.density.shape[-1]
    share, centre = _kernel(size)
    window = share[:, None, None] * share[:, None] * share
    spacing = half_extent * 2 / (size - 1)
    along_normal = payload.density * window * spacing[:, 2, None, None, None]
    covered = np.cumsum(along_normal[:, ::-1], 1)[:, ::-1] - along_normal  # by the voxels further out
    cell, d, h, w = np.nonzero((along_normal >= LEAST) & (covered < COVERED))
    in_plane = np.sqrt(spacing[:, 0] * spacing[:, 1]) / spacing[:, 2]
    opacity = 1 - np.exp(-GAIN * along_normal[cell, d, h, w] * in_plane[cell])
    shown = opacity >= FAINTEST
    cell, d, h, w, opacity = (values[shown] for values in (cell, d, h, w, opacity))
    order = np.argsort(_lattice(d, h, w), kind="stable")
    cell, d, h, w, opacity = (values[order] for values in (cell, d, h, w, opacity))
    local = np.stack([centre[w], centre[h], centre[d]], -1) * half_extent[cell]
    return Splats(
        cell.astype(np.int32),
        local.astype(np.float32),
        (spacing[cell] * WIDTH).astype(np.float32),
        np.minimum(opacity, MOST_OPAQUE).astype(np.float32),
        payload.rgb[cell, :, d, h, w].clip(0, 1).astype(np.float32),
    )


def _lattice(d: NDArray, h: NDArray, w: NDArray) -> NDArray[np.int64]:
    """The coarsest of four nested lattices that has this voxel: all even, every eighth (0); all odd or all even (1);
    with an even sum (2); any (3). So the first 1/8, 1/4 and 1/2 of splats in this order cover the human evenly."""
    odd = np.stack([d, h, w]) % 2
    alike = (odd[0] == odd[1]) & (odd[1] == odd[2])
    return np.where(alike, odd[0], np.where(odd.sum(0) % 2 == 0, 2, 3))


def _kernel(size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mass and centroid of each voxel's linear kernel times the window, along one axis."""
    place = np.linspace(-1, 1, 4001)
    spacing = 2 / (size - 1)
    voxel = np.linspace(-1, 1, size)[:, None]
    left = (1 - np.abs(place - voxel) / spacing).clip(0) * np.exp(-8.0 * np.abs(place) ** WINDOW_EXPONENT)
    mass = left.sum(1)
    return mass * (2 / 4000) / spacing, (left * place).sum(1) / mass


def encode_srgb(linear: NDArray) -> NDArray[np.float64]:
    """sRGB-encoded colours of linear ones in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def fill(cloud: bpy.types.PointCloud, splats: Splats) -> None:
    """Make a point cloud these splats, whatever it was."""
    cloud.resize(len(splats.cell))
    cloud.type = "GAUSSIAN_SPLAT"
    radiance = np.c_[(encode_srgb(splats.rgb) - 0.5) / C0, splats.opacity]
    for name, kind, field, values in (
        ("position", "FLOAT_VECTOR", "vector", splats.position),
        ("scale", "FLOAT_VECTOR", "vector", splats.scale),
        ("radiance:base", "FLOAT4", "vector", radiance),
        (CELL, "INT", "value", splats.cell),
    ):
        attribute = cloud.attributes.get(name) or cloud.attributes.new(name, kind, "POINT")
        data = np.ascontiguousarray(values, np.int32 if kind == "INT" else np.float32)
        attribute.data.foreach_set(field, data.ravel())
    cloud.update_tag()


def build_splats(person: bpy.types.Object) -> bpy.types.Object:
    """Give a human splats, which follow its body, and the cells on which they lie.

    Raises as `read_human`, and ValueError where the body mesh was deleted. Makes no undo step.
    """
    human, body, betas = read_human(session_file(person)), body_of(person), betas_of(person)
    if body is None:
        raise ValueError(f"the body mesh of {person.name!r} was deleted: undo that, or generate the human again")
    growth = human.model.growth(generated_betas(person), betas)
    mesh = cell_mesh(f"{person.name}_cells", human.model, betas, growth)
    cloud = bpy.data.pointclouds.new(f"{person.name}_splats")
    cells, splats = (bpy.data.objects.new(data.name, data) for data in (mesh, cloud))
    cells.hide_viewport = cells.hide_render = True
    cells[CELLS_MARK] = splats[SPLATS_MARK] = True
    for part in (splats, cells):
        part.parent = person
        link_part(person, part)
    fill(cloud, splats_of(human))
    add_nodes(splats, "Follow Body", splat_group(), {BODY: body, CELLS: cells})
    return splats


def cloud_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's splats; None for humans without, which were made in an earlier Blender."""
    return next((obj for obj in parts_of(person) if obj.type == "POINTCLOUD" and SPLATS_MARK in obj), None)


def cells_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The cells on which they lie; None where there are none."""
    return next((obj for obj in parts_of(person) if obj.type == "MESH" and CELLS_MARK in obj), None)


def replace_splats(person: bpy.types.Object, human: RestHuman) -> None:
    """Show another human's voxels by the splats of this one, if it has any. Earlier Blenders, which cannot write them,
    remove them instead: *Show As* makes them again."""
    splats, cells = cloud_of(person), cells_of(person)
    if splats is not None and SPLATS_AVAILABLE:
        fill(own_data(splats, person), splats_of(human))
        return
    for part in filter(None, (splats, cells)):
        bpy.data.objects.remove(part)


GROUP_NAME = "PrimDiffusion Splats on Body"
CELL = "cell"
"""Attribute of splats: the index of their primitive. Their `position` is in its axes T, B, N, metres."""
BODY, CELLS = "Body", "Cells"
SIZE, DETAIL, SHADING, SUN = "Size", "Detail", "Shading", "Sun"
"""Inputs of the group."""
C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""
_IN_SHADOW = 0.3
"""Share of the light that reaches skin which is turned away from the sun."""
_GAMMA = 2.2


def splat_group() -> bpy.types.NodeTree:
    """The shared node group, made on first use."""
    return shared_group(GROUP_NAME) or _build(NodeGroup(GROUP_NAME, "Moves the splats of a human with its body"))


def _build(group: NodeGroup) -> bpy.types.NodeTree:
    group.socket("Splats", "INPUT", "NodeSocketGeometry")
    group.socket(BODY, "INPUT", "NodeSocketObject", "The human's body mesh, which its armature bends")
    group.socket(CELLS, "INPUT", "NodeSocketObject", "How each box of the human lies on the body mesh")
    group.socket("Splats", "OUTPUT", "NodeSocketGeometry")
    for name, most, description in (
        (DETAIL, 1.0, "Share of the splats that is drawn, larger ones where it is less: 0.12 for crowds"),
        (SIZE, 10.0, "Factor on the size of every splat"),
    ):
        item = group.socket(name, "INPUT", "NodeSocketFloat", description)
        item.default_value, item.min_value, item.max_value = 1.0, 0.01, most
    item = group.socket(SHADING, "INPUT", "NodeSocketFloat", "How much the sun shades the human; 0: as generated")
    item.subtype, item.min_value, item.max_value = "FACTOR", 0.0, 1.0
    group.socket(SUN, "INPUT", "NodeSocketObject", "A sun lamp; without one the light comes from above")
    node, vector, scalar = group.node, group.vector, group.scalar
    inputs = node("NodeGroupInput").outputs
    body, cells = group.geometry_of(inputs[BODY]), group.geometry_of(inputs[CELLS])
    centre, rotation, growth = group.frames(body)
    cell = group.attribute(CELL, "INT")

    def of_cell(value: bpy.types.NodeSocket, kind: str) -> bpy.types.NodeSocket:
        return node(
            "GeometryNodeSampleIndex",
            {"Geometry": cells, "Value": value, "Index": cell},
            data_type=kind,
            domain="POINT",
        ).outputs["Value"]

    turn, size = of_cell(rotation, "QUATERNION"), of_cell(growth, "FLOAT_VECTOR")
    position = node("GeometryNodeInputPosition").outputs[0]
    offset = node("FunctionNodeRotateVector", {0: vector("MULTIPLY", position, size), 1: turn}).outputs[0]
    place = vector("ADD", of_cell(centre, "FLOAT_VECTOR"), offset)

    def stored(points: bpy.types.NodeSocket, name: str, kind: str, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return node(
            "GeometryNodeStoreNamedAttribute",
            {"Geometry": points, "Name": name, "Value": value},
            data_type=kind,
            domain="POINT",
        ).outputs["Geometry"]

    # the first splats are those of the coarser lattices: see `splats.splats_of`
    whole, detail = inputs["Splats"], inputs[DETAIL]
    count = node("GeometryNodeAttributeDomainSize", {"Geometry": whole}, component="POINTCLOUD").outputs["Point Count"]
    left_out = node(
        "FunctionNodeCompare",
        {"A": node("GeometryNodeInputIndex").outputs[0], "B": scalar("MULTIPLY", count, detail)},
        data_type="FLOAT",
        operation="GREATER_EQUAL",
    ).outputs["Result"]
    points = node("GeometryNodeDeleteGeometry", {"Geometry": whole, "Selection": left_out}, domain="POINT")
    points = stored(points.outputs["Geometry"], "rotation", "QUATERNION", turn)
    larger = scalar("MULTIPLY", inputs[SIZE], scalar("POWER", detail, -1 / 3))
    scale = node(
        "ShaderNodeVectorMath",
        {0: vector("MULTIPLY", group.attribute("scale", "FLOAT_VECTOR"), size), "Scale": larger},
        operation="SCALE",
    ).outputs[0]
    points = stored(points, "scale", "FLOAT_VECTOR", scale)
    up = (0.0, 0.0, 1.0)
    sun = node("GeometryNodeObjectInfo", {"Object": inputs[SUN]}, transform_space="RELATIVE").outputs["Rotation"]
    to_sun, normal = (node("FunctionNodeRotateVector", {0: up, 1: by}).outputs[0] for by in (sun, turn))
    lit = scalar("MAXIMUM", vector("DOT_PRODUCT", normal, to_sun), 0.0)
    dimmed = scalar("MULTIPLY", scalar("SUBTRACT", 1.0, lit), scalar("MULTIPLY", inputs[SHADING], 1 - _IN_SHADOW))
    factor = scalar("POWER", scalar("SUBTRACT", 1.0, dimmed), 1 / _GAMMA)  # of encoded colours
    radiance = group.attribute("radiance:base", "FLOAT_COLOR")
    encoded = vector("MULTIPLY_ADD", radiance, (C0,) * 3, (0.5,) * 3)
    shaded = node("ShaderNodeVectorMath", {0: encoded, "Scale": factor}, operation="SCALE").outputs[0]
    channels = node("ShaderNodeSeparateXYZ", {0: vector("MULTIPLY_ADD", shaded, (1 / C0,) * 3, (-0.5 / C0,) * 3)})
    colour = dict(zip(("Red", "Green", "Blue"), channels.outputs, strict=True))
    opacity = node("FunctionNodeSeparateColor", {0: radiance}).outputs["Alpha"]
    shown = node("FunctionNodeCombineColor", {**colour, "Alpha": opacity}).outputs[0]
    points = stored(points, "radiance:base", "FLOAT_COLOR", shown)
    points = node("GeometryNodeSetPosition", {"Geometry": points, "Position": place}).outputs["Geometry"]
    group.put(node("NodeGroupOutput").inputs["Splats"], points)
    return group.tree
