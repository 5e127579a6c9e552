"""A human at rest, read from its own file and the file of its body."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..formats.human_metadata import provenance_of
from ..formats.regular_files import FileError, as_file_error
from .body import body_of_file
from .cycles import max_overlap
from .human import LARGEST_BETA
from .human_file import GENERATE_AGAIN, HumanPayload, payload_in, read_tensors
from .shape import Rest, ShapeModel
from .volumes import Grids, bake


@dataclasses.dataclass(frozen=True, eq=False)
class RestHuman:
    """A human at rest, in the backend's axes (y up, metres); `convention` turns them into Blender's."""

    made: dict[str, Any]
    """Provenance: seed, steps, checkpoint, full_density, version."""
    payload: HumanPayload
    model: ShapeModel
    rest: Rest
    """The model at the payload's betas."""

    def grids(self) -> Grids:
        """The voxels of its volumes."""
        half_extent = self.rest_half_extent * self.payload.delta_scale
        return bake(self.payload.density, np.moveaxis(self.payload.rgb, 1, -1), half_extent)

    @property
    def rest_half_extent(self) -> NDArray[np.float64]:
        """Half sides of the boxes before their delta scale [K, 3], metres."""
        own = self.payload.rest_half_extent
        return np.asarray(self.model.rest_half_extent if own is None else own, np.float64)

    def provenance(self, grids: Grids) -> str:
        """JSON for the custom property `human.MARK`; `grids` as above."""
        offset, half = grids.drawn_box()
        centre = self.rest.position + np.einsum("kij,kj->ki", self.rest.rotation, offset)
        betas = np.round(self.payload.betas.astype(np.float64), 6).tolist()
        most = max_overlap(centre, self.rest.rotation, half)
        return json.dumps({**self.made, "betas": betas, "most_overlapping": most})


def read_human(person: Path, remedy: str = GENERATE_AGAIN) -> RestHuman:
    """Read a human and its body; `remedy` says what to do about a damaged file.

    Raises FileNotFoundError where a file is missing, ValueError for a damaged one, a newer one and one on another body,
    OSError.
    """
    if not person.is_file():
        raise FileNotFoundError(f"there is no human file at {str(person)!r}; generate the human again")
    tensors = read_tensors(person, remedy)
    payload = payload_in(tensors, person.name, remedy)
    if np.abs(payload.betas).max() > LARGEST_BETA:
        raise FileError(person, f"has betas above {LARGEST_BETA}", remedy)
    with as_file_error(person, "is damaged", remedy):
        made = provenance_of(tensors.metadata)
    model = body_of_file(person)
    if len(payload.density) != len(model.face):
        reason = f"holds {len(payload.density)} primitives instead of its body's {len(model.face)}"
        raise FileError(person, reason, remedy)
    return RestHuman(made, payload, model, model.rest(payload.betas.astype(np.float64)))
