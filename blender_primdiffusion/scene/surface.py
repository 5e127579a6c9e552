"""Attachment to the surface: volumes on the tangent planes of the posed body, for every pose (paper sec. 3.1).

An object without faces, the carrier, has a point for each weight of the sums that give a primitive's centre and axes. A
node group evaluates them on the skinned body:

    body vertex * weights, summed per primitive -> centre, dP/du, dP/dv
    T = normalize(dP/du), N = normalize(T x dP/dv) -> an instance of the volume, scaled
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import body_of, link_part, own_data, parts_of, volumes_of
from .rest_human import shape_model_of
from .shape import ShapeModel, betas_of, generated_betas

MARK = "primdiffusion_surface"
"""Custom property of a carrier."""
_DELETED = -1
GROUP_NAME = "PrimDiffusion Boxes on Surface"
VERTEX, PRIMITIVE, FIRST, PICK, GROWTH = "vertex", "primitive", "first", "pick", "growth"
WEIGHTS = ("centre_weight", "du_weight", "dv_weight")
"""Attributes of the carrier's points: see `surface.carrier_mesh`."""
BODY, VOLUMES = "Body", "Volumes"
"""Inputs of the group."""


def carrier_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's carrier; None before it was first attached to the surface."""
    return next((obj for obj in parts_of(person) if MARK in obj), None)


def primitives_of(person: bpy.types.Object) -> bpy.types.Collection | None:
    """The collection of the human's volumes; None for a human without. Raises ValueError where they have none to
    themselves."""
    body, volumes = body_of(person), [obj for objects in volumes_of(person).values() for obj in objects]
    if not volumes:
        return None
    inside = Counter(collection for obj in volumes for collection in obj.users_collection)
    own = [collection for collection, _ in inside.most_common() if body is None or body.name not in collection.objects]
    if not own:
        raise ValueError(f"the volumes of {person.name!r} are in no collection of their own: move them into a new one")
    return own[0]


def build_surface(person: bpy.types.Object) -> bpy.types.Object:
    """Make or update the human's carrier; shows and hides nothing (see `attachment`).

    Raises ValueError for a human of an earlier version, or whose body mesh was deleted or changed, and
    FileNotFoundError where the body's file is missing.
    """
    model, body, primitives = shape_model_of(person), body_of(person), primitives_of(person)
    if body is None or len(body.data.vertices) != len(model.template):
        state = "was deleted" if body is None else "has other vertices now"
        raise ValueError(
            f"the body mesh of {person.name!r} {state}: undo that, or generate the human again, to attach volumes "
            "to its surface"
        )
    carrier = carrier_of(person)
    growth = model.growth(generated_betas(person), betas_of(person))
    mesh = carrier_mesh(f"{person.name}_surface", model, picks(person, primitives, len(model.face)))
    if carrier is None:
        carrier = bpy.data.objects.new(mesh.name, mesh)
        carrier[MARK] = True
        carrier.parent = person
        link_part(person, carrier)
    else:
        former, carrier.data = carrier.data, mesh
        if former.users == 0:
            bpy.data.meshes.remove(former)
    scale_surface(person, growth)
    modifier = carrier.modifiers.get("Surface") or carrier.modifiers.new("Surface", "NODES")
    modifier.node_group = surface_group()
    sockets = {
        item.name: item.identifier for item in modifier.node_group.interface.items_tree if item.in_out == "INPUT"
    }
    set_node_input(modifier, sockets[BODY], body)
    set_node_input(modifier, sockets[VOLUMES], primitives)
    return carrier


def scale_surface(person: bpy.types.Object, growth: NDArray) -> None:
    """Scale the volumes on the human's carrier, if there is one, by `growth` [K, 3]."""
    carrier = carrier_of(person)
    if carrier is None:
        return
    set_of_primitives(own_data(carrier, person), GROWTH, growth)


def set_of_primitives(mesh: bpy.types.Mesh, name: str, values: NDArray) -> None:
    """Set a vector attribute of a `carrier_mesh` from the values of the primitives [K, 3]."""
    primitive = np.empty(len(mesh.vertices), np.int32)
    mesh.attributes[PRIMITIVE].data.foreach_get("value", primitive)
    attribute = mesh.attributes.get(name) or mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", values[primitive].astype(np.float32).ravel())
    mesh.update_tag()


def picks(person: bpy.types.Object, primitives: bpy.types.Collection, count: int) -> NDArray[np.int32]:
    """The index of each primitive's volume among the collection's children [count]; -1 where it was deleted.

    The node sorts objects and collections together, by name, as `_natural_order` does.
    """
    children = sorted([*primitives.objects, *primitives.children], key=lambda child: _natural_order(child.name))
    rank = {child: number for number, child in enumerate(children)}
    found = np.full(count, _DELETED, np.int32)
    for k, objects in volumes_of(person).items():
        here = [rank[obj] for obj in objects if obj in rank]
        if here and k < count:
            found[k] = min(here)
    return found


def carrier_mesh(name: str, model: ShapeModel, pick: NDArray) -> bpy.types.Mesh:
    """A vertex, with its weights, for each body vertex in the sums of each primitive's centre and tangent plane.

    Vertex k is the first of primitive k.
    """
    count, width = model.stencil_vertex.shape
    vertex = np.concatenate([model.faces[model.face], model.stencil_vertex], 1)
    no_corners, no_stencil = np.zeros((count, 3)), np.zeros((count, width))
    weights = (
        np.concatenate([model.barycentric, no_stencil], 1),
        np.concatenate([no_corners, model.stencil_du], 1),
        np.concatenate([no_corners, model.stencil_dv], 1),
    )
    used = np.any([weight != 0 for weight in weights], 0)
    used[:, 0] = False
    others, columns = np.nonzero(used)
    primitive = np.concatenate([np.arange(count), others])
    column = np.concatenate([np.zeros(count, np.int64), columns])
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(primitive))
    for attribute, kind, values in (
        (VERTEX, "INT", vertex[primitive, column].astype(np.int32)),
        (PRIMITIVE, "INT", primitive.astype(np.int32)),
        (PICK, "INT", np.maximum(pick, 0)[primitive].astype(np.int32)),
        (FIRST, "BOOLEAN", (np.arange(len(primitive)) < count) & (pick[primitive] != _DELETED)),
        *(
            (weight_name, "FLOAT", values[primitive, column].astype(np.float32))
            for weight_name, values in zip(WEIGHTS, weights, strict=True)
        ),
    ):
        mesh.attributes.new(attribute, kind, "POINT").data.foreach_set("value", values)
    return mesh


def surface_group() -> bpy.types.NodeTree:
    """The shared node group, made on first use; its inputs are the body's object and the collection of volumes."""
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


def node_inputs(modifier: bpy.types.NodesModifier) -> dict[str, Any]:
    """Inputs of a modifier by socket identifier, without sockets that have no value (geometry).

    They are custom properties of the modifier up to Blender 5.1, of its `properties` from 5.2.
    """
    group = modifier.node_group
    if group is None:
        return {}
    items = group.interface.items_tree
    sockets = [item.identifier for item in items if item.item_type == "SOCKET" and item.in_out == "INPUT"]
    if bpy.app.version < (5, 2):
        return {name: modifier[name] for name in sockets if name in modifier}
    values = {name: getattr(modifier.properties.inputs, name, None) for name in sockets}
    return {name: value.value for name, value in values.items() if hasattr(value, "value")}


def set_node_input(modifier: bpy.types.NodesModifier, socket: str, value: Any) -> None:
    """Set the input of a modifier with this socket identifier."""
    if bpy.app.version < (5, 2):
        modifier[socket] = value
    else:
        getattr(modifier.properties.inputs, socket).value = value


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

    group_input = node("NodeGroupInput").outputs
    body = node("GeometryNodeObjectInfo", {"Object": group_input[BODY]}, transform_space="RELATIVE").outputs["Geometry"]
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
    points = node("GeometryNodeSetPosition", {"Geometry": group_input["Geometry"], "Position": centre})
    volumes = node(
        "GeometryNodeCollectionInfo",
        {"Collection": group_input[VOLUMES], "Separate Children": True, "Reset Children": True},
    ).outputs["Instances"]
    instances = node(
        "GeometryNodeInstanceOnPoints",
        {
            "Points": points.outputs["Geometry"],
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


def _natural_order(name: str) -> list[tuple[int, int, str]]:
    """Sort key of names as Blender sorts them: digits by value, letters regardless of case."""
    parts = re.findall(r"\d+|\D", name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]
