"""Jobs that generate a human, and edits, which change one in place."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy_extras.view3d_utils import region_2d_to_location_3d

from ..backend.requests import sentence
from ..formats.answers import HumanAnswer
from ..scene.build import build_human
from ..scene.edit import Replaced, replace_person, select_human
from ..scene.human import HumanTarget, humans, session_file
from ..scene.place import stand_at_cursor
from ..scene.representation import in_viewport, representation_of
from ..scene.volume_nodes import set_folder
from .queue import PREVIEW_PX, Job, chosen_checkpoint
from .volumes import write_or_report


def build_person(context: bpy.types.Context, result: HumanAnswer, made: str) -> tuple[bpy.types.Object, str]:
    """Build the human of the child's `result`; returns them and the message ("Generated in 1.2 s.").

    Raises as `build_human` does, and then leaves nothing.
    """
    began = time.monotonic()
    person = add_human(context, build_human(context, result.person))
    notice = f"{made} in {result.seconds + time.monotonic() - began:.1f} s"
    return person, " ".join([sentence(notice), *map(sentence, result.warnings)])


def add_human(context: bpy.types.Context, person: bpy.types.Object) -> bpy.types.Object:
    """Have a new human stand at the cursor, selected, and in sight if it is the first; returns it."""
    stand_at_cursor(context, person)
    if context.mode == "OBJECT":  # else the user is posing or painting
        select_human(context, person)
        if len(humans(context.scene)) == 1:
            frame_in_view()
    return person


def frame_in_view() -> None:
    """Have the first 3D view frame what is selected, beside its sidebar, unless a view looks through a camera."""
    if bpy.app.background:
        return
    bpy.context.view_layer.update()
    views = [
        (window, area)
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        if area.type == "VIEW_3D" and area.spaces.active.local_view is None
    ]
    if not views or any(area.spaces.active.region_3d.view_perspective == "CAMERA" for _, area in views):
        return
    window, area = views[0]
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_selected()
    sidebar, around = next(one for one in area.regions if one.type == "UI"), area.spaces.active.region_3d
    covered = region.x + region.width - sidebar.x if sidebar.width > 1 and sidebar.alignment == "RIGHT" else 0
    if covered > 0:
        around.view_distance *= max(1.0, min(region.width, region.height) / (region.width - covered))
        around.update()
        beside = ((region.width + covered) / 2, region.height / 2)
        around.view_location = region_2d_to_location_3d(region, around, beside, around.view_location)


_STEP_PICTURE_PX = 256
"""Width and height of the panel's picture after each step, pixels."""


@dataclasses.dataclass(frozen=True)
class GenerateJob(Job):
    """Generate Human."""

    kind = method = "generate"
    undo = "Generate Human"

    seed: int
    sampling: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Other fields of `GenerateRequest`: steps, sampler, attributes, guidance."""
    checkpoint: str = dataclasses.field(default_factory=chosen_checkpoint)
    next_seed: int | None = None
    """What the panel's seed becomes with this human; None where it was not used, or is locked."""

    @property
    def label(self) -> str:
        return f"Human, seed {self.seed}"

    def params(self, folder: Path) -> dict[str, Any]:
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        previews = {"size": PREVIEW_PX, "picture_px": _STEP_PICTURE_PX}
        asked = {"seed": self.seed, **self.sampling, "compact": True}  # it goes into the .blend
        return {**asked, **previews, **checkpoint, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        notice = build_person(context, result, "Generated")[1]
        if self.next_seed is not None:
            context.scene.primdiffusion.seed = self.next_seed
        return notice


def show_in_place(context: bpy.types.Context, person: bpy.types.Object, result: HumanAnswer) -> Replaced:
    """Show the human of the child's `result` in place of `person`. Raises as `replace_person` does."""
    done = replace_person(person, result.person)
    if representation_of(person) == "VOLUMES" and in_viewport(person):
        write_or_report(person)
        set_folder(person, session_file(person).parent, again=True)
    return done


_EDITS = {
    "vary": ("Vary Human", "Varied"),
    "inpaint": ("Regenerate Region", "Re-dressed"),
    "transfer": ("Transfer Texture", "Texture transferred to"),
    "interpolate": ("Blend Humans", "Blended"),
}
"""By the child's method: the undo step, and what stands before the human's name in the message."""


@dataclasses.dataclass
class EditJob(Job):
    """Change a human in place: vary it, generate a region again, transfer one from another human, or blend the two."""

    method: str
    target: HumanTarget
    asked: Mapping[str, Any]
    """Fields of the request. A region {"painted": [V numbers]} holds weights, and travels as a file."""
    checkpoint: str = dataclasses.field(default_factory=chosen_checkpoint)

    @classmethod
    def of(cls, method: str, person: bpy.types.Object, asked: Mapping[str, Any]) -> EditJob:
        """Raises ValueError for a human that cannot be edited."""
        session_file(person)
        return cls(method, HumanTarget.of(person), asked)

    def __post_init__(self) -> None:
        self.kind = self.method
        self.undo, self.made = _EDITS[self.method]

    @property
    def label(self) -> str:
        return f"{self.undo}: {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        asked = dict(self.asked)
        if isinstance(asked.get("region"), Mapping):
            painted = asked.pop("region")["painted"]
            np.savez(folder / "region.npz", weights=np.asarray(painted, np.float32))
            asked["weights"] = str(folder / "region.npz")
        checkpoint = {"checkpoint": self.checkpoint} if self.checkpoint else {}
        previews = {"size": PREVIEW_PX, "picture_px": _STEP_PICTURE_PX}
        return {**asked, "person": self.target.file_now(), **previews, **checkpoint, "out_dir": str(folder)}

    def finish(self, context: bpy.types.Context, result: HumanAnswer, _folder: Path) -> str:
        person = self.target.found()
        done = show_in_place(context, person, result)
        shape = "; the body's shape has changed too" if done.reshaped else ""
        message = f"{self.made} {person.name} in {result.seconds:.1f} s"
        warnings = (*result.warnings, done.warning)
        return " ".join([f"{message}{shape}.", *(sentence(text) for text in warnings if text)])
