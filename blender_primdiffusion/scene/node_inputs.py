"""Inputs of Geometry Nodes modifiers: custom properties of the modifier until 5.1, of its `properties` since 5.2."""

from __future__ import annotations

from typing import Any

import bpy


def node_inputs(modifier: bpy.types.NodesModifier) -> dict[str, Any]:
    """Values by identifiers of sockets; sockets without a value (geometry) are left out."""
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
    """Set the input with this identifier."""
    if bpy.app.version < (5, 2):
        modifier[socket] = value
    else:
        getattr(modifier.properties.inputs, socket).value = value
