"""Humans as assets, with words and a picture for the Asset Browser."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..formats.answers import RenderAnswer
from ..formats.joints import JOINT_NAMES
from ..scene.blend_values import as_shown
from ..scene.human import HumanTarget, provenance_of
from ..scene.payload import session_file
from .queue import Job

_PICTURE, _SIDE = "asset.png", 256
_ARMS_DOWN = 1.15
"""Radians from the T pose, so that a human fills the picture."""


@dataclasses.dataclass(frozen=True)
class HumanAssetJob(Job):
    """Draw a picture, then mark the human as an asset. Blender draws none of an armature."""

    kind = "human_asset"
    method = "render"
    undo = "Mark Human as Asset"

    target: HumanTarget

    @property
    def label(self) -> str:
        return f"Picture of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        pose = np.zeros((len(JOINT_NAMES), 3))
        pose[JOINT_NAMES.index("left_shoulder"), 2] = -_ARMS_DOWN
        pose[JOINT_NAMES.index("right_shoulder"), 2] = _ARMS_DOWN
        human, out = str(session_file(self.target.found())), str(folder / _PICTURE)
        return {"human": human, "out": out, "pose": pose.ravel().tolist(), "width": _SIDE, "height": _SIDE}

    def finish(self, _context: bpy.types.Context, _result: RenderAnswer, folder: Path) -> str:
        person = self.target.found()
        made = provenance_of(person)
        asked = made.get("attributes")
        asked = asked if isinstance(asked, dict) else {}
        seed = f"seed {as_shown(made['seed'])}" if "seed" in made else "no seed"
        said = [f"{as_shown(name)} {as_shown(value)}" for name, value in asked.items()]
        person.asset_mark()
        about = person.asset_data
        about.description = ", ".join(["Generated human", seed, *said])
        for tag in ("human", *(as_shown(value) for value in asked.values() if isinstance(value, str))):
            about.tags.new(tag, skip_if_exists=True)
        with bpy.context.temp_override(id=person):
            bpy.ops.ed.lib_id_load_custom_preview(filepath=str(folder / _PICTURE))
        return f"{person.name} is an asset now; save the file in a folder of your asset libraries"
