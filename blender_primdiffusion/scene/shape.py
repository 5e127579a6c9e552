"""The shape of people in the scene: their betas, and what follows from them."""

from __future__ import annotations

import bpy

from . import shape_file
from .human import folders_of
from .shape_model import ShapeModel


def shape_model_of(collection: bpy.types.Collection) -> ShapeModel:
    """How the person's body follows its shape. Raises ValueError or FileNotFoundError with what to do."""
    if shape_file.BODY_FILE not in collection:
        raise ValueError(
            f"the person {collection.name!r} was made by an earlier version and keeps their shape: generate the person "
            "again, or vary them, to reshape"
        )
    name = str(collection[shape_file.BODY_FILE])
    places = [place / name for near in folders_of(collection) for place in (near.parent, near)]
    return shape_file.read(next((place for place in places if place.is_file()), places[0]))
