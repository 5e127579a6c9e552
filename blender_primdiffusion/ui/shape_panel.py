"""The section Shape of the panel Human; the human's shape is a property of the armature, applied at once."""

from __future__ import annotations

import random
from collections.abc import Sequence

import bpy
import numpy as np

from ..backend.requests import sentence
from ..files.regular_files import printable
from ..scene.edit import check_shapeable, reshape
from ..scene.human import BETA_COUNT, LARGEST_BETA, is_human, selected_person
from ..scene.human_file import shape_model_of
from ..scene.shape import BodyMeasures, betas_of, betas_of_measures, generated_betas, measure, slider_names
from .declared import SKIP
from .drawing import draw_lines, draw_section, property_columns
from .on_person import HumanOperator

_NOT_ANIMATED: set[str] = set()
"""Options: an animation would move the rest bones in each frame; the custom property can be animated instead."""
_FARTHEST = 3.0
_SHAPES = (
    ("RANDOM", "Random", "Give the selected human a random body shape; the same seed gives the same shape"),
    ("GENERATED", "As Generated", "Reset the selected human to the shape of the last edit, or of generation"),
)


def person_of(armature: bpy.types.Object) -> bpy.types.Object:
    """The human whose properties these are. Raises ValueError for another object."""
    if not is_human(armature):
        raise ValueError(f"the object {armature.name!r} is not a human: select one")
    return armature


def measures_of(armature: bpy.types.Object) -> BodyMeasures:
    """Height and weight as set by the sliders. Raises ValueError or FileNotFoundError where they are unknown."""
    person = person_of(armature)
    return measure(shape_model_of(person), betas_of(person))


def _betas(self: PRIMDIFFUSION_PG_human) -> Sequence[float]:
    try:
        return betas_of(person_of(self.id_data)).tolist()
    except ValueError:
        return (0.0,) * BETA_COUNT


def _set_betas(self: PRIMDIFFUSION_PG_human, betas: Sequence[float]) -> None:
    _log_errors(lambda: reshape(person_of(self.id_data), np.clip(list(betas), -LARGEST_BETA, LARGEST_BETA)))


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
    _log_errors(lambda: set_measures(person_of(self.id_data), height=height))


def _set_weight(self: PRIMDIFFUSION_PG_human, weight: float) -> None:
    _log_errors(lambda: set_measures(person_of(self.id_data), measures_of(self.id_data).height, weight))


def set_measures(person: bpy.types.Object, height: float | None = None, weight: float | None = None) -> str:
    """Reshape a human as little as possible to `height` metres and `weight` kilograms.

    Raises ValueError where no body has these, and as `reshape`.
    """
    return reshape(person, betas_of_measures(shape_model_of(person), betas_of(person), height, weight))


def _log_errors(change) -> None:
    """Print errors: setters must not raise, and the panel shows beforehand what cannot be set."""
    try:
        change()
    except (OSError, ValueError) as error:
        print(printable(f"PrimDiffusion: {error}"))


class PRIMDIFFUSION_PG_human(bpy.types.PropertyGroup):
    """`armature.primdiffusion_human`."""

    __slots__ = ()
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


class PRIMDIFFUSION_OT_reshape(HumanOperator, bpy.types.Operator):
    """Set the body shape of the selected human: at random, or as generated"""

    bl_idname = "primdiffusion.reshape"
    bl_label = "Reshape Human"
    bl_options = {"REGISTER", "UNDO"}  # fast enough to be redone with other settings
    described_by = ("to",)

    to: bpy.props.EnumProperty(name="Reshape To", description="Which shape", items=_SHAPES, options=SKIP)
    seed: bpy.props.IntProperty(name="Seed", description="Another seed gives another body", min=0, options=SKIP)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.to == "RANDOM" and not self.given("seed"):
            self.seed = random.randrange(2**31)
        return self.execute(context)

    def draw(self, _context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
        for name in ("to", "seed") if self.to == "RANDOM" else ("to",):
            layout.prop(self, name)

    def run(self, _context: bpy.types.Context, person: bpy.types.Object) -> set[str]:
        drawn = np.random.default_rng(self.seed).normal(size=BETA_COUNT)
        random_betas = np.clip(drawn, -_FARTHEST, _FARTHEST)
        warning = reshape(person, random_betas if self.to == "RANDOM" else generated_betas(person))
        if warning:
            self.report({"WARNING"}, sentence(warning))
        return {"FINISHED"}


def draw_shape(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Height, weight and the sliders of the selected human's shape."""
    person = selected_person(context)
    try:
        names = slider_names(shape_model_of(person))
        check_shapeable(person)
    except (OSError, ValueError) as error:
        draw_lines(layout, sentence(error), "INFO")
        return
    settings = person.primdiffusion_human
    layout.prop(settings, "height")
    layout.prop(settings, "weight")
    _draw_sliders(layout, settings, {index: name for index, name in enumerate(names) if not name.isdecimal()})
    row = layout.row(align=True)
    row.operator("primdiffusion.reshape", text="Random", icon="FILE_REFRESH").to = "RANDOM"
    row.operator("primdiffusion.reshape", text="Reset", icon="LOOP_BACK").to = "GENERATED"
    if (body := draw_section(layout, "more_sliders", text="More Sliders")) is not None:
        _draw_sliders(body, settings, {index: name for index, name in enumerate(names) if name.isdecimal()})


def _draw_sliders(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, names: dict[int, str]) -> None:
    """Sliders of some betas, by their index."""
    column = layout.column(align=True) if names else layout  # an empty column leaves a gap
    for index, name in names.items():
        column.prop(settings, "betas", index=index, text=name, slider=True)


PROPERTIES = ((bpy.types.Object, "primdiffusion_human", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_human)),)
