"""The node group that puts a person's volumes on their posed surface, as the paper does for every pose (sec. 3.1).

a point for each weight of each primitive's sums -> the body's vertex, times the weights, summed over the primitive
-> centre, dP/du, dP/dv -> T = normalize(dP/du), N = normalize(T x dP/dv) -> an instance of the volume, grown
"""

from __future__ import annotations

import bpy

GROUP_NAME = "PrimDiffusion Boxes on Surface"
VERTEX, PRIMITIVE, FIRST, PICK, GROWTH = "vertex", "primitive", "first", "pick", "growth"
WEIGHTS = ("centre_weight", "du_weight", "dv_weight")
"""Attributes of the carrier's points: see `surface.carrier_mesh`."""
BODY, VOLUMES = "Body", "Volumes"
"""Inputs of the group."""


def surface_group() -> bpy.types.NodeTree:
    """The shared group, made on first use; its inputs are the body's object and the collection of volumes."""
    existing = bpy.data.node_groups.get(GROUP_NAME)
    if existing is not None and existing.library is None and existing.bl_idname == "GeometryNodeTree":
        return existing
    tree = bpy.data.node_groups.new(GROUP_NAME, "GeometryNodeTree")
    for name, direction, kind in (
        ("Geometry", "INPUT", "NodeSocketGeometry"),
        (BODY, "INPUT", "NodeSocketObject"),
        (VOLUMES, "INPUT", "NodeSocketCollection"),
        ("Geometry", "OUTPUT", "NodeSocketGeometry"),
    ):
        tree.interface.new_socket(name, in_out=direction, socket_type=kind)
    _build(tree)
    return tree


def _build(tree: bpy.types.NodeTree) -> None:
    made: list[bpy.types.Node] = []

    def node(kind: str, inputs: dict[str | int, object] | None = None, **values: object) -> bpy.types.Node:
        one = tree.nodes.new(kind)
        one.location = (180 * (len(made) % 8), -220 * (len(made) // 8))
        made.append(one)
        for key, value in values.items():
            setattr(one, key, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                tree.links.new(value, one.inputs[key])
            else:
                one.inputs[key].default_value = value
        return one

    def attribute(name: str, kind: str) -> bpy.types.NodeSocket:
        return node("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind).outputs["Attribute"]

    given = node("NodeGroupInput").outputs
    body = node("GeometryNodeObjectInfo", {"Object": given[BODY]}, transform_space="RELATIVE").outputs["Geometry"]
    vertex = node(
        "GeometryNodeSampleIndex",
        {"Geometry": body, "Value": node("GeometryNodeInputPosition").outputs[0], "Index": attribute(VERTEX, "INT")},
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
    normal = node("ShaderNodeVectorMath", {0: du, 1: dv}, operation="CROSS_PRODUCT").outputs[0]
    rotation = node(
        "FunctionNodeAxesToRotation",
        {"Primary Axis": normal, "Secondary Axis": du},
        primary_axis="Z",
        secondary_axis="X",
    ).outputs["Rotation"]
    placed = node("GeometryNodeSetPosition", {"Geometry": given["Geometry"], "Position": centre}).outputs["Geometry"]
    volumes = node(
        "GeometryNodeCollectionInfo", {"Collection": given[VOLUMES], "Separate Children": True, "Reset Children": True}
    ).outputs["Instances"]
    instances = node(
        "GeometryNodeInstanceOnPoints",
        {
            "Points": placed,
            "Selection": attribute(FIRST, "BOOLEAN"),
            "Instance": volumes,
            "Pick Instance": True,
            "Instance Index": attribute(PICK, "INT"),
            "Rotation": rotation,
            "Scale": attribute(GROWTH, "FLOAT_VECTOR"),
        },
    )
    output = node("NodeGroupOutput")
    tree.links.new(instances.outputs["Instances"], output.inputs["Geometry"])
