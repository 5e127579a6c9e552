"""Cells of a human: how each of its boxes lies on the skin, as a mesh and as geometry nodes (paper sec. 3.1).

The mesh has no faces. Its points hold the weights of the sums over body vertices that give a box's centre and axes, and
nodes evaluate them on the skinned body, so that Blender's own skinning moves what lies in the boxes:

    body vertex * weights, summed per primitive -> centre, dP/du, dP/dv
    T = normalize(dP/du), N = normalize(T x dP/dv), and sides that stretch with the skin
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.body_layout import LARGEST_STRETCH
from .human import own_data, parts_of
from .human_file import default_body
from .shape import ShapeModel

VERTEX, PRIMITIVE, FIRST = "vertex", "primitive", "first"
WEIGHTS = ("centre_weight", "du_weight", "dv_weight")
GROWTH, REST_SIDES = "growth", "rest_sides"
"""Attributes of the points: a body vertex, its primitive, whether this is the primitive's first point, the weights; and
of the primitive the scale that a changed shape brings, and its length and width at rest, metres."""
_NEVER_STRETCHED = 1e3
"""Side of a cell, metres, that no skin reaches."""


def cell_mesh(name: str, model: ShapeModel, betas: NDArray, growth: NDArray) -> bpy.types.Mesh:
    """The cells of a body of these betas [10], scaled by `growth` [K, 3]; vertex k is the first of primitive k."""
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
        (FIRST, "BOOLEAN", np.arange(len(primitive)) < count),
        *(
            (weight_name, "FLOAT", values[primitive, column].astype(np.float32))
            for weight_name, values in zip(WEIGHTS, weights, strict=True)
        ),
    ):
        mesh.attributes.new(attribute, kind, "POINT").data.foreach_set("value", values)
    _scale(mesh, model, betas, growth)
    return mesh


def scale_cells(person: bpy.types.Object, model: ShapeModel, betas: NDArray, growth: NDArray) -> None:
    """Have a human's volumes and splats grow by `growth` [K, 3] with its body, which now has these betas [10]."""
    for obj in parts_of(person):
        if obj.type == "MESH" and {PRIMITIVE, GROWTH, REST_SIDES} <= set(obj.data.attributes.keys()):
            _scale(own_data(obj, person), model, betas, growth)


def _scale(mesh: bpy.types.Mesh, model: ShapeModel, betas: NDArray, growth: NDArray) -> None:
    sides = np.full((len(model.face), 3), _NEVER_STRETCHED)
    if model is default_body():  # the released code's boxes, on other bodies, do not follow the skin
        sides[:, :2] = model.rest_sides(betas)
    primitive = np.empty(len(mesh.vertices), np.int32)
    mesh.attributes[PRIMITIVE].data.foreach_get("value", primitive)
    for name, values in ((GROWTH, growth), (REST_SIDES, sides)):
        attribute = mesh.attributes.get(name) or mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        of_points = values[primitive.clip(0, len(values) - 1)]
        attribute.data.foreach_set("vector", of_points.astype(np.float32).ravel())
    mesh.update_tag()


class NodeGroup:
    """A node group in the making; each node is placed to the right of the one before."""

    def __init__(self, name: str, description: str) -> None:
        self.tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
        self.tree.description = description
        self.tree.is_modifier = True
        self._count = 0

    def socket(self, name: str, direction: str, kind: str, description: str = "") -> bpy.types.NodeTreeInterfaceSocket:
        """A new input or output of the group."""
        return self.tree.interface.new_socket(name, description=description, in_out=direction, socket_type=kind)

    def node(self, kind: str, inputs: dict[str | int, object] | None = None, **values: object) -> bpy.types.Node:
        """A new node with these properties, whose inputs are linked to sockets or have values."""
        new = self.tree.nodes.new(kind)
        new.location = (180 * (self._count % 8), -220 * (self._count // 8))
        self._count += 1
        for key, value in values.items():
            setattr(new, key, value)
        for key, value in (inputs or {}).items():
            self.put(new.inputs[key], value)
        return new

    def put(self, socket: bpy.types.NodeSocket, value: object) -> None:
        """Link an input to a socket, or give it a value."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        else:
            socket.default_value = value

    def attribute(self, name: str, kind: str) -> bpy.types.NodeSocket:
        """An attribute of the geometry that is evaluated."""
        return self.node("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind).outputs["Attribute"]

    def vector(self, operation: str, *inputs: bpy.types.NodeSocket | tuple) -> bpy.types.NodeSocket:
        """A result of vector arithmetic."""
        made = self.node("ShaderNodeVectorMath", dict(enumerate(inputs)), operation=operation)
        return made.outputs["Value" if operation in ("LENGTH", "DOT_PRODUCT") else "Vector"]

    def scalar(self, operation: str, *inputs: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        """A result of arithmetic."""
        return self.node("ShaderNodeMath", dict(enumerate(inputs)), operation=operation).outputs[0]

    def geometry_of(self, obj: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """The evaluated geometry of an object, in the space of the one that has the modifier."""
        return self.node("GeometryNodeObjectInfo", {"Object": obj}, transform_space="RELATIVE").outputs["Geometry"]

    def frames(
        self, body: bpy.types.NodeSocket
    ) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket, bpy.types.NodeSocket]:
        """Fields on a `cell_mesh`: centre, rotation and scale of the boxes on the posed `body`."""
        position = self.node("GeometryNodeInputPosition").outputs[0]
        vertex = self.node(
            "GeometryNodeSampleIndex",
            {"Geometry": body, "Value": position, "Index": self.attribute(VERTEX, "INT")},
            data_type="FLOAT_VECTOR",
            domain="POINT",
        ).outputs["Value"]
        group = self.attribute(PRIMITIVE, "INT")

        def summed(weight: str) -> bpy.types.NodeSocket:
            inputs = {0: vertex, "Scale": self.attribute(weight, "FLOAT")}
            weighted = self.node("ShaderNodeVectorMath", inputs, operation="SCALE")
            total = self.node(
                "GeometryNodeAccumulateField",
                {"Value": weighted.outputs[0], "Group ID": group},
                data_type="FLOAT_VECTOR",
                domain="POINT",
            )
            return total.outputs["Total"]

        centre, du, dv = (summed(weight) for weight in WEIGHTS)
        normal = self.vector("CROSS_PRODUCT", du, dv)
        rotation = self.node(
            "FunctionNodeAxesToRotation",
            {"Primary Axis": normal, "Secondary Axis": du},
            primary_axis="Z",
            secondary_axis="X",
        ).outputs["Rotation"]
        length = self.vector("LENGTH", du)
        width = self.scalar("DIVIDE", self.vector("LENGTH", normal), length)  # area by length
        sides = self.node("ShaderNodeCombineXYZ", {0: length, 1: width, 2: 0.0}).outputs[0]
        stretch = self.vector("DIVIDE", sides, self.attribute(REST_SIDES, "FLOAT_VECTOR"))
        stretch = self.vector("MINIMUM", self.vector("MAXIMUM", stretch, (1.0,) * 3), (LARGEST_STRETCH,) * 3)
        return centre, rotation, self.vector("MULTIPLY", stretch, self.attribute(GROWTH, "FLOAT_VECTOR"))


def shared_group(name: str) -> bpy.types.NodeTree | None:
    """The node group of this name in the .blend, if it is there."""
    found = bpy.data.node_groups.get(name)
    return found if found and found.library is None and found.bl_idname == "GeometryNodeTree" else None


def add_nodes(obj: bpy.types.Object, name: str, group: bpy.types.NodeTree, inputs: dict[str, object]) -> None:
    """Give an object a modifier with this group and these inputs, by name."""
    modifier = obj.modifiers.new(name, "NODES")
    modifier.node_group = group
    for key, value in inputs.items():
        set_input(modifier, key, value)


def set_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Set an input of a modifier by its name in the group."""
    socket = _sockets(modifier)[name]
    if bpy.app.version < (5, 2):
        modifier[socket] = value
    else:
        getattr(modifier.properties.inputs, socket).value = value


def _sockets(modifier: bpy.types.NodesModifier) -> dict[str, str]:
    """Identifiers of a group's inputs by their names."""
    items = modifier.node_group.interface.items_tree if modifier.node_group is not None else ()
    return {item.name: item.identifier for item in items if item.item_type == "SOCKET" and item.in_out == "INPUT"}
