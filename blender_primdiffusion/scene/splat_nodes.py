"""The node group by which splats follow a skinned body; one for all humans."""

from __future__ import annotations

import bpy

from .cells import NodeGroup, shared_group

GROUP_NAME = "PrimDiffusion Splats on Body"
CELL = "cell"
"""Attribute of splats: the index of their primitive. Their `position` is in its axes T, B, N, metres."""
BODY, CELLS = "Body", "Cells"
SIZE, DETAIL = "Size", "Detail"
"""Inputs of the group."""


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
    points = node("GeometryNodeSetPosition", {"Geometry": points, "Position": place}).outputs["Geometry"]
    group.put(node("NodeGroupOutput").inputs["Splats"], points)
    return group.tree
