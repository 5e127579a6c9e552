"""What can be said about any motion that is put onto a person, from a file or built in."""

from __future__ import annotations

import bpy


class WhereTo:
    """Properties of operators that key a motion; their values are those of `placing.Placement`."""

    start: bpy.props.IntProperty(name="Start Frame", description="Frame of the scene with the first pose", default=1)
    root: bpy.props.EnumProperty(
        name="Root Motion",
        description="What becomes of the way through space",
        items=[
            ("ORIGIN", "From the Person", "The path begins where the person is"),
            ("KEEP", "As It Is", "The path keeps its place, which may be metres away"),
            ("PLACE", "In Place", "The person stays where they are; only heights are kept"),
        ],
    )
    into: bpy.props.EnumProperty(
        name="Into",
        description="Where the keys go",
        items=[
            ("NEW", "New Action", "A new action; the one before stays in the file"),
            ("APPEND", "Append", "After the last key of the action the person has"),
            ("STRIP", "NLA Strip", "A strip on a new track of the nonlinear animation"),
        ],
    )
    extend: bpy.props.BoolProperty(
        name="Extend Scene",
        description="Move the end of the scene to the end of the motion if it is later",
        default=True,
    )
