"""Show, select, build and clear variations."""

from __future__ import annotations

import random
from typing import Any

import bpy
from bpy.app.translations import pgettext_tip

from ..formats.requests import AMOUNT
from ..jobs.follow import redraw, submit
from ..jobs.pictures import icons
from ..jobs.seeds import LARGEST_SEED, last_seed
from ..jobs.variations import Variation, sheet
from ..worker.sentence import sentence
from .generate_settings import STEPS_AND_SAMPLER, Asking

COUNT_ITEMS = [(str(count), str(count), f"{count} people") for count in (4, 8, 12, 16)]


class PRIMDIFFUSION_PG_variations(bpy.types.PropertyGroup):
    """`scene.primdiffusion_variations`."""

    count: bpy.props.EnumProperty(
        name="Count", description="How many people to choose from", items=COUNT_ITEMS, default="8"
    )
    seeds: bpy.props.EnumProperty(
        name="Seeds",
        description="Which people",
        items=[
            ("CONSECUTIVE", "From Seed On", "The seed of the panel Generate and those that follow on it"),
            ("RANDOM", "Random", "Others each time"),
        ],
        default="RANDOM",
    )
    quality: bpy.props.EnumProperty(
        name="Quality",
        description="People are built exactly as shown here, in this quality",
        items=[
            ("PANEL", "As Generate", "The steps and sampler of the panel Generate: what is built needs no refining"),
            (
                "DRAFT",
                "Draft",
                "8 steps of DPM-Solver++: quicker and softer. Generating the seed again with more steps refines the "
                "person, and now and then makes another one of it",
            ),
        ],
    )
    amount: bpy.props.FloatProperty(
        name="Difference",
        description="How much More Like This differs from the chosen person: 0 not at all, 1 completely",
        default=AMOUNT,
        min=0.05,
        max=1.0,
        subtype="FACTOR",
    )


_SELECTED = "Which one, counted from 0; -1: those that are selected"
_SKIP = {"SKIP_SAVE"}
_BUILD_ALL = "Add all of these people to the scene, side by side"


class _Variations(Asking):
    """What the operators that fill the sheet have in common."""

    count: bpy.props.IntProperty(
        name="Count", default=0, min=0, max=64, description="How many people; 0: the panel's", options=_SKIP
    )

    def seeds(self, context: bpy.types.Context, first: int) -> tuple[int, ...]:
        """`count` of them from `first` on, or random ones where it is negative. Raises ValueError."""
        count = self.count or int(context.scene.primdiffusion_variations.count)
        if first < 0:
            return tuple(random.sample(range(LARGEST_SEED + 1), count))
        return tuple(range(first, last_seed(first, count) + 1))

    def sheet_sampling(self, context: bpy.types.Context) -> dict[str, Any]:
        """As `sampling`, in the quality of the sheet."""
        sampling = self.sampling(context.scene.primdiffusion)
        if context.scene.primdiffusion_variations.quality == "DRAFT":
            steps, sampler = STEPS_AND_SAMPLER["DRAFT"]
            sampling |= {"steps": self.steps or steps, "sampler": self.sampler if self.given("sampler") else sampler}
        return sampling


class PRIMDIFFUSION_OT_variations(_Variations, bpy.types.Operator):
    """Show several people to choose from before building them"""

    bl_idname = "primdiffusion.variations"
    bl_label = "Show Variations"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put them in line; in background mode this waits for them. A seed from a script is the first of `count`."""
        random_ones = context.scene.primdiffusion_variations.seeds == "RANDOM"
        first = -1 if random_ones else context.scene.primdiffusion.seed
        try:
            seeds = self.seeds(context, self.seed if self.seed >= 0 else first)
            sampling = self.sheet_sampling(context)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return _submit(self, context, seeds, sampling)


class PRIMDIFFUSION_OT_more_like_variation(_Variations, bpy.types.Operator):
    """Show variations of the selected person, with the same body, instead of these"""

    bl_idname = "primdiffusion.more_like_variation"
    bl_label = "More Like This"

    index: bpy.props.IntProperty(name="Index", default=-1, min=-1, description=_SELECTED, options=_SKIP)
    amount: bpy.props.FloatProperty(
        name="Difference", min=0.0, max=1.0, description="Not given: the panel's", options=_SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """There is a sheet."""
        return _poll_sheet(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put them in line; in background mode this waits for them. A seed from a script is the first of `count`."""
        try:
            around = _targets(self.index)
            if len(around) > 1:
                raise ValueError(f"{len(around)} variations are selected: select only the one to vary")
            seeds = self.seeds(context, self.seed)
            sampling = self.sheet_sampling(context)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        amount = self.amount if self.given("amount") else context.scene.primdiffusion_variations.amount
        title = f"Like seed {around[0].seed}"
        person = str(around[0].person)
        return _submit(self, context, seeds, sampling | {"person": person, "amount": amount, "title": title})


class PRIMDIFFUSION_OT_select_variation(bpy.types.Operator):
    """Select this person, or not"""

    bl_idname = "primdiffusion.select_variation"
    bl_label = "Select Variation"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    index: bpy.props.IntProperty(name="Index", description="Place in the sheet, from 0", min=0, options=_SKIP)

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """There is a sheet."""
        return _poll_sheet(cls)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Toggles."""
        try:
            variation = sheet.at(self.index)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        variation.chosen = not variation.chosen
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_build_variation(bpy.types.Operator):
    """Add the selected people to the scene, exactly as shown, side by side"""

    bl_idname = "primdiffusion.build_variation"
    bl_label = "Build Selected"
    bl_options: set[str] = set()  # noqa: RUF012  the step of undo is made here, with its name

    index: bpy.props.IntProperty(name="Index", default=-1, min=-1, description=_SELECTED, options=_SKIP)
    build_all: bpy.props.BoolProperty(name="All", description="Build all people of the sheet", options=_SKIP)

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """There is a sheet."""
        return _poll_sheet(cls)

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        """The tooltip."""
        return pgettext_tip(_BUILD_ALL if properties.build_all else str(cls.__doc__))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Takes seconds for each; one step of undo for all."""
        from ..scene.overlap import overlap_warning_in  # numpy, which Blender starts without

        try:
            wanted = list(sheet.variations) if self.build_all else _targets(self.index)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        built, failure = _build(context, wanted)
        if built:
            bpy.ops.ed.undo_push(message="Build Variation" if len(built) == 1 else f"Build {len(built)} Variations")
        if failure:
            self.report({"ERROR"}, f"{len(built)} of {len(wanted)} people were built. {failure}")
            return {"FINISHED"} if built else {"CANCELLED"}
        for person in built:
            if warning := overlap_warning_in(context.scene, person):
                self.report({"WARNING"}, sentence(warning))
        return {"FINISHED"}


class PRIMDIFFUSION_OT_use_variation_seed(bpy.types.Operator):
    """Set the seed of the panel Generate to that of the selected person and lock it"""

    bl_idname = "primdiffusion.use_variation_seed"
    bl_label = "Use Seed"
    bl_options = {"UNDO"}  # noqa: RUF012

    index: bpy.props.IntProperty(name="Index", default=-1, min=-1, description=_SELECTED, options=_SKIP)

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """There is a sheet."""
        return _poll_sheet(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Of one person; variants of a person have seeds that mean nothing to Generate."""
        try:
            wanted = _targets(self.index)
            if len(wanted) > 1:
                raise ValueError(f"{len(wanted)} variations are selected: select one")
            if sheet.around:
                raise ValueError("variants of a person cannot be generated from a seed alone: build them instead")
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        settings = context.scene.primdiffusion
        settings.seed, settings.keep_seed = wanted[0].seed, True
        return {"FINISHED"}


class PRIMDIFFUSION_OT_clear_variations(bpy.types.Operator):
    """Clear the sheet and delete its files; people in the scene stay"""

    bl_idname = "primdiffusion.clear_variations"
    bl_label = "Clear Variations"
    bl_options: set[str] = set()  # noqa: RUF012

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """There is a sheet."""
        return _poll_sheet(cls)

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Files and pictures go."""
        sheet.clear()
        icons.free()
        redraw()
        return {"FINISHED"}


def _poll_sheet(cls: type[bpy.types.Operator]) -> bool:
    cls.poll_message_set("There are no variations: press Show Variations first")
    return bool(sheet.variations)


def _submit(
    operator: bpy.types.Operator, context: bpy.types.Context, seeds: tuple[int, ...], fields: dict[str, Any]
) -> set[str]:
    from ..jobs.variations import VariationsJob

    return submit(operator, context, VariationsJob(seeds, **fields))


def _targets(index: int) -> list[Variation]:
    return sheet.chosen() if index < 0 else [sheet.at(index)]


def _build(context: bpy.types.Context, wanted: list[Variation]) -> tuple[list[bpy.types.Collection], str]:
    """Whom it could build before something went wrong, and that in a sentence; empty when nothing did."""
    from ..scene.build import build_human, stand_beside_others

    built: list[bpy.types.Collection] = []
    context.window_manager.progress_begin(0, len(wanted))
    try:
        for variation in wanted:
            person = build_human(context, variation.human, "Human", [variation.person])
            built.append(person)
            stand_beside_others(context, person)
            context.window_manager.progress_update(len(built))
    except (ValueError, OSError) as error:
        return built, sentence(error)
    finally:
        context.window_manager.progress_end()
    return built, ""


CLASSES = (
    PRIMDIFFUSION_PG_variations,
    PRIMDIFFUSION_OT_variations,
    PRIMDIFFUSION_OT_more_like_variation,
    PRIMDIFFUSION_OT_select_variation,
    PRIMDIFFUSION_OT_build_variation,
    PRIMDIFFUSION_OT_use_variation_seed,
    PRIMDIFFUSION_OT_clear_variations,
)
PROPERTIES = (
    (bpy.types.Scene, "primdiffusion_variations", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_variations)),
)
