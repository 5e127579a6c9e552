"""A human's name, shape and loop as properties of its armature: read from the scene, and applied to it at once."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ..scene.actions import action_curves, end_repeat, loops, repeat
from ..scene.body import shape_model_of
from ..scene.duplicate import rename_human
from ..scene.human import BETA_COUNT, LARGEST_BETA, MARK
from ..scene.reshape import reshape
from ..scene.shape import BodyMeasures, betas_of, betas_of_measures, measure

_NOT_ANIMATED: set[str] = set()
"""Options: an animation would move the rest bones in each frame; the custom property can be animated instead."""


def person_of(armature: bpy.types.Object) -> bpy.types.Collection:
    """The human whose armature this is. Raises ValueError for another object."""
    for collection in armature.users_collection:
        if MARK in collection:
            return collection
    raise ValueError(f"the object {armature.name!r} is not the armature of a human: select one")


def measures_of(armature: bpy.types.Object) -> BodyMeasures:
    """Height and weight as set by the sliders. Raises ValueError or FileNotFoundError where they are unknown."""
    person = person_of(armature)
    return measure(shape_model_of(person), betas_of(person))


def _name(self: PRIMDIFFUSION_PG_human) -> str:
    try:
        return person_of(self.id_data).name
    except ValueError:
        return ""


def _rename(self: PRIMDIFFUSION_PG_human, name: str) -> None:
    _printed(lambda: rename_human(person_of(self.id_data), name))


def _betas(self: PRIMDIFFUSION_PG_human) -> Sequence[float]:
    try:
        return betas_of(person_of(self.id_data)).tolist()
    except ValueError:
        return (0.0,) * BETA_COUNT


def _set_betas(self: PRIMDIFFUSION_PG_human, betas: Sequence[float]) -> None:
    _printed(lambda: reshape(person_of(self.id_data), np.clip(list(betas), -LARGEST_BETA, LARGEST_BETA)))


def _measure(self: PRIMDIFFUSION_PG_human) -> BodyMeasures:
    try:
        return measures_of(self.id_data)
    except (OSError, ValueError):
        return BodyMeasures(0.0, 0.0)


def _height(self: PRIMDIFFUSION_PG_human) -> float:
    return _measure(self).height


def _weight(self: PRIMDIFFUSION_PG_human) -> float:
    return _measure(self).weight


def _set_height(self: PRIMDIFFUSION_PG_human, height: float) -> None:
    _printed(lambda: set_measures(person_of(self.id_data), height=height))


def _set_weight(self: PRIMDIFFUSION_PG_human, weight: float) -> None:
    _printed(lambda: set_measures(person_of(self.id_data), measures_of(self.id_data).height, weight))


def set_measures(person: bpy.types.Collection, height: float | None = None, weight: float | None = None) -> str:
    """Reshape a human as little as possible to `height` metres and `weight` kilograms.

    Raises ValueError where no body has these, and as `reshape`.
    """
    return reshape(person, betas_of_measures(shape_model_of(person), betas_of(person), height, weight))


def _printed(change) -> None:
    """Print errors: setters must not raise, and the panel shows beforehand what cannot be set."""
    try:
        change()
    except (OSError, ValueError) as error:
        print(f"PrimDiffusion: {error}")


def _looped(self: PRIMDIFFUSION_PG_human) -> bool:
    return action_curves(self.id_data) is not None and loops(self.id_data)


def _loop(self: PRIMDIFFUSION_PG_human, looped: bool) -> None:
    if action_curves(self.id_data) is None:
        print(f"PrimDiffusion: {self.id_data.name!r} has no action to loop: import or add a motion first")
    elif looped != loops(self.id_data):
        (repeat if looped else end_repeat)(self.id_data)


class PRIMDIFFUSION_PG_human(bpy.types.PropertyGroup):
    """`armature.primdiffusion_human`."""

    person: bpy.props.StringProperty(
        name="Name", description="Name of the human's collection and its objects", get=_name, set=_rename
    )
    betas: bpy.props.FloatVectorProperty(
        name="Shape",
        description="Difference from the mean body, in standard deviations",
        size=BETA_COUNT,
        min=-LARGEST_BETA,
        max=LARGEST_BETA,
        soft_min=-3.0,
        soft_max=3.0,
        step=5,
        precision=2,
        options=_NOT_ANIMATED,
        get=_betas,
        set=_set_betas,
    )
    height: bpy.props.FloatProperty(
        name="Height (m)",
        description="Metres from sole to crown at rest, barefoot; weight and proportions follow",
        min=0.5,
        max=3.0,
        soft_min=1.4,
        soft_max=2.1,
        step=1,
        precision=3,
        options=_NOT_ANIMATED,
        get=_height,
        set=_set_height,
    )
    weight: bpy.props.FloatProperty(
        name="Weight (kg)",
        description="Kilograms of the body without clothes; the height stays",
        min=10.0,
        max=300.0,
        soft_min=40.0,
        soft_max=120.0,
        step=50,
        precision=1,
        options=_NOT_ANIMATED,
        get=_weight,
        set=_set_weight,
    )
    loop: bpy.props.BoolProperty(
        name="Loop",
        description="Loop the motion; a walk continues from where it has arrived",
        options=_NOT_ANIMATED,
        get=_looped,
        set=_loop,
    )


PROPERTIES = ((bpy.types.Object, "primdiffusion_human", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_human)),)
