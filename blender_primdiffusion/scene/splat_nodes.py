"""The node group by which splats follow a skinned body; one for all humans."""

from __future__ import annotations

import bpy

from ..formats.body_layout import LARGEST_STRETCH
from .surface import GROWTH, PRIMITIVE, VERTEX, WEIGHTS, set_node_input

GROUP_NAME = "PrimDiffusion Splats on Body"
CELL = "cell"
"""Attribute of splats: the index of their primitive. Their `position` is in its axes T, B, N, metres."""
REST_SIDES = "rest_sides"
"""Attribute of cells: length and width at rest, metres."""
BODY, CELLS = "Body", "Cells"
SIZE, DETAIL = "Size", "Detail"
"""Inputs of the group."""


def follow_body(splats: bpy.types.Object, body: bpy.types.Object, cells: bpy.types.Object) -> None:
    """Add the modifier that puts splats on the posed body."""
    modifier = splats.modifiers.new("Follow Body", "NODES")
    modifier.node_group = splat_group()
    items = modifier.node_group.interface.items_tree
    sockets = {item.name: item.identifier for item in items if item.in_out == "INPUT"}
    set_node_input(modifier, sockets[BODY], body)
    set_node_input(modifier, sockets[CELLS], cells)


def splat_group() -> bpy.types.NodeTree:
    """The shared node group, made on first use."""
    existing = bpy.data.node_groups.get(GROUP_NAME)
    if existing is not None and existing.library is None and existing.bl_idname == "GeometryNodeTree":
        return existing
    tree = bpy.data.node_groups.new(GROUP_NAME, "GeometryNodeTree")
    tree.description = "Moves the splats of a human with its body"
    tree.is_modifier = True
    for name, direction, kind, description in (
        ("Splats", "INPUT", "NodeSocketGeometry", ""),
        (BODY, "INPUT", "NodeSocketObject", "The human's body mesh, which its armature bends"),
        (CELLS, "INPUT", "NodeSocketObject", "How each box of the human lies on the body mesh"),
        ("Splats", "OUTPUT", "NodeSocketGeometry", ""),
    ):
        tree.interface.new_socket(name, description=description, in_out=direction, socket_type=kind)
    for name, most, description in (
        (DETAIL, 1.0, "Share of the splats that is drawn, larger ones where it is less: 0.12 for crowds"),
        (SIZE, 10.0, "Factor on the size of every splat"),
    ):
        item = tree.interface.new_socket(name, description=description, in_out="INPUT", socket_type="NodeSocketFloat")
        item.default_value, item.min_value, item.max_value = 1.0, 0.01, most
    _build(tree)
    return tree


def _build(tree: bpy.types.NodeTree) -> None:
    made: list[bpy.types.Node] = []

    def node(kind: str, inputs: dict[str | int, object] | None = None, **values: object) -> bpy.types.Node:
        new = tree.nodes.new(kind)
        new.location = (180 * (len(made) % 8), -220 * (len(made) // 8))
        made.append(new)
        for key, value in values.items():
            setattr(new, key, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                tree.links.new(value, new.inputs[key])
            else:
                new.inputs[key].default_value = value
        return new

    def attribute(name: str, kind: str) -> bpy.types.NodeSocket:
        return node("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind).outputs["Attribute"]

    def vector(operation: str, *inputs: bpy.types.NodeSocket | tuple) -> bpy.types.NodeSocket:
        made = node("ShaderNodeVectorMath", dict(enumerate(inputs)), operation=operation)
        return made.outputs["Value" if operation in ("LENGTH", "DOT_PRODUCT") else "Vector"]

    def scalar(operation: str, *inputs: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        return node("ShaderNodeMath", dict(enumerate(inputs)), operation=operation).outputs[0]

    def geometry_of(obj: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return node("GeometryNodeObjectInfo", {"Object": obj}, transform_space="RELATIVE").outputs["Geometry"]

    group_input = node("NodeGroupInput").outputs
    body, cells = geometry_of(group_input[BODY]), geometry_of(group_input[CELLS])
    position = node("GeometryNodeInputPosition").outputs[0]
    vertex = node(
        "GeometryNodeSampleIndex",
        {"Geometry": body, "Value": position, "Index": attribute(VERTEX, "INT")},
        data_type="FLOAT_VECTOR",
        domain="POINT",
    ).outputs["Value"]
    group = attribute(PRIMITIVE, "INT")

    def summed(weight: str) -> bpy.types.NodeSocket:
        weighted = node("ShaderNodeVectorMath", {0: vertex, "Scale": attribute(weight, "FLOAT")}, operation="SCALE")
        total = node(
            "GeometryNodeAccumulateField",
            {"Value": weighted.outputs[0], "Group ID": group},
            data_type="FLOAT_VECTOR",
            domain="POINT",
        )
        return total.outputs["Total"]

    centre, du, dv = (summed(weight) for weight in WEIGHTS)
    normal = vector("CROSS_PRODUCT", du, dv)
    rotation = node(
        "FunctionNodeAxesToRotation",
        {"Primary Axis": normal, "Secondary Axis": du},
        primary_axis="Z",
        secondary_axis="X",
    ).outputs["Rotation"]
    # length of the cell, and width: its area by its length
    length = vector("LENGTH", du)
    width = scalar("DIVIDE", vector("LENGTH", normal), length)
    sides = node("ShaderNodeCombineXYZ", {0: length, 1: width, 2: 0.0}).outputs[0]
    stretch = vector("DIVIDE", sides, attribute(REST_SIDES, "FLOAT_VECTOR"))
    stretch = vector("MINIMUM", vector("MAXIMUM", stretch, (1.0,) * 3), (LARGEST_STRETCH,) * 3)
    growth = vector("MULTIPLY", stretch, attribute(GROWTH, "FLOAT_VECTOR"))

    cell = attribute(CELL, "INT")

    def of_cell(value: bpy.types.NodeSocket, kind: str) -> bpy.types.NodeSocket:
        return node(
            "GeometryNodeSampleIndex",
            {"Geometry": cells, "Value": value, "Index": cell},
            data_type=kind,
            domain="POINT",
        ).outputs["Value"]

    turn, size = of_cell(rotation, "QUATERNION"), of_cell(growth, "FLOAT_VECTOR")
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
    whole, detail = group_input["Splats"], group_input[DETAIL]
    count = node("GeometryNodeAttributeDomainSize", {"Geometry": whole}, component="POINTCLOUD").outputs["Point Count"]
    left_out = node(
        "FunctionNodeCompare",
        {"A": node("GeometryNodeInputIndex").outputs[0], "B": scalar("MULTIPLY", count, detail)},
        data_type="FLOAT",
        operation="GREATER_EQUAL",
    ).outputs["Result"]
    points = node("GeometryNodeDeleteGeometry", {"Geometry": whole, "Selection": left_out}, domain="POINT")
    points = stored(points.outputs["Geometry"], "rotation", "QUATERNION", turn)
    larger = scalar("MULTIPLY", group_input[SIZE], scalar("POWER", detail, -1 / 3))
    scale = node(
        "ShaderNodeVectorMath",
        {0: vector("MULTIPLY", attribute("scale", "FLOAT_VECTOR"), size), "Scale": larger},
        operation="SCALE",
    ).outputs[0]
    points = stored(points, "scale", "FLOAT_VECTOR", scale)
    points = node("GeometryNodeSetPosition", {"Geometry": points, "Position": place}).outputs["Geometry"]
    output = node("NodeGroupOutput")
    tree.links.new(points, output.inputs["Splats"])
