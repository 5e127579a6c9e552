"""Generated humans as subjects of captures: drawn by the marcher, in the poses and from the cameras of meshes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from primdiffusion.body.model import BodyModel
from primdiffusion.capture.people_files import SUBJECT_NAME, read_person
from primdiffusion.capture.reader import as_camera
from primdiffusion.capture.render import Renderable
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.image import Image
from primdiffusion.human import Human, body_of, place_skinned
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Primitives, S
from primdiffusion.raster.rasterise import Draw, check_samples
from primdiffusion.render.march import march

ENDINGS = (".human.safetensors", ".human")
OWN_FOLDER = ("person.human.safetensors", "person.glb")
"""Names of files in folders of their own: Blender's generated humans, and those of `primdiffusion people`."""
PATTERNS = (*(f"*{ending}" for ending in ENDINGS), *(f"*/{name}" for name in OWN_FOLDER))
"""Patterns of the files of humans in a folder."""
PASSES = ("img", "mask", "depth")
"""Passes that volumes have."""
VISIBLE = 0.03
"""Opacity of a voxel from which it counts where cameras and floor are placed; the surface lies within about 5 mm."""
RAYS_AT_ONCE = 2**21
"""Rays of a band of a picture: limits memory."""


@dataclasses.dataclass(frozen=True, eq=False)
class VolumetricPerson:
    """A generated human, as captures take it."""

    human: Human

    @property
    def betas(self) -> Float[np.ndarray, "n"]:
        """Shape coefficients of the body."""
        return self.human.betas.double().numpy()

    @property
    def body(self) -> BodyModel:
        """The human's own body."""
        return body_of(self.human)[0]

    @functools.cached_property
    def _visible(self) -> torch.Tensor:
        shown = visible_voxels(self._boxes(np.tile(np.eye(4), (24, 1, 1))))
        if not shown.any():
            raise ValueError("the human is empty, no voxel is visible: generate it again")
        return shown

    def _boxes(self, skinning: Float[np.ndarray, "J 4 4"]) -> Primitives:
        return place_skinned(self.human, torch.from_numpy(skinning).float(), torch.eye(4))

    def points(self, skinning: Float[np.ndarray, "J 4 4"]) -> Float[np.ndarray, "n 3"]:
        """Centres of the visible voxels in the world, metres. Raises ValueError if no voxel is visible."""
        boxes = self._boxes(skinning)
        box, depth, row, column = self._visible.nonzero(as_tuple=True)
        places = torch.linspace(-1, 1, S)
        local = torch.stack([places[column], places[row], places[depth]], dim=-1) * boxes.half_extent[box]
        turned = (boxes.rotation[box] * local[:, None]).sum(-1)
        return (boxes.position[box] + turned).double().numpy()

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> Draw:
        """Pose the human; depth is the first hit of the ray through the pixel's centre, at opacity one half."""
        return functools.partial(_draw, self._boxes(skinning))


def _draw(primitives: Primitives, view: View, samples: int) -> Image:
    check_samples(samples)
    image = Image.blank(view.width, view.height)
    rows = max(1, RAYS_AT_ONCE // (view.width * samples**2))
    for top in range(0, view.height, rows):
        _draw_band(primitives, view, samples, slice(top, min(top + rows, view.height)), image)
    return image


def _draw_band(primitives: Primitives, view: View, samples: int, rows: slice, image: Image) -> None:
    height = rows.stop - rows.start
    finer = np.array([[samples, 0, 0], [0, samples, -rows.start * samples], [0, 0, 1.0]]) @ view.intrinsics
    fine = View(finer, view.rotation, view.translation, view.width * samples, height * samples)
    drawn = march(primitives, as_camera(fine))
    blocks = height, samples, view.width, samples
    image.rgb[rows] = drawn.rgb.numpy().reshape(*blocks, 3).mean((1, 3)).clip(0, 1)
    image.alpha[rows] = drawn.alpha.numpy().reshape(blocks).mean((1, 3))
    image.depth[rows] = (
        drawn.first_hit.numpy()[samples // 2 :: samples, samples // 2 :: samples]
        / as_camera(view).secants().numpy()[rows]
    )


def visible_voxels(primitives: Primitives) -> torch.Tensor:
    """Whether the opacity across each voxel [K, S, S, S] is at least VISIBLE."""
    faded = torch.exp(-WINDOW_SHARPNESS * torch.linspace(-1, 1, S).pow(WINDOW_POWER))
    window = faded[:, None, None] * faded[:, None] * faded
    edge = 2 * primitives.half_extent.amin(-1) / (S - 1)
    return primitives.density * window * edge[:, None, None, None] >= VISIBLE


def find_subjects(path: str | Path) -> dict[str, Path]:
    """Find the humans of a folder, generated ones and those of `primdiffusion people`, sorted by name; or one file.

    Generated ones are NAME.human, NAME.human.safetensors or NAME/person.human.safetensors.

    Raises:
        FileNotFoundError: the folder does not exist or contains none.
        ValueError: two files have one name, or the name of a file is not that of a subject.
    """
    path = Path(path)
    if path.is_file():
        name = _name(path)
        if is_generated(path) and SUBJECT_NAME.fullmatch(name):
            return {name: path}
        raise ValueError(f"{path} cannot be captured: choose a folder, or NAME.human of letters, digits and . _ -")
    found: dict[str, Path] = {}
    for file in sorted(file for pattern in PATTERNS for file in path.glob(pattern)):
        name = _name(file)
        if name in found:
            raise ValueError(f"{found[name]} and {file} are two humans of one name: rename one")
        if SUBJECT_NAME.fullmatch(name):
            found[name] = file
    if not found:
        raise FileNotFoundError(
            f"{path} contains no NAME/person.glb and no NAME.human: make some with primdiffusion people or generate"
        )
    return dict(sorted(found.items()))


def is_generated(path: Path) -> bool:
    """Whether a file is, by its name, a generated human."""
    return path.name.endswith(ENDINGS)


def renderer_name(paths: Sequence[Path]) -> str:
    """Renderer of the humans of these files, as dataset.json names it."""
    generated = {is_generated(path) for path in paths}
    return " and ".join(name for kind, name in ((False, "rasteriser"), (True, "marcher")) if kind in generated)


def read_subject(path: Path) -> Renderable:
    """Read a human for captures. Raises as `load_human` and `read_person`."""
    return VolumetricPerson(load_human(path)) if is_generated(path) else read_person(path)


def _name(path: Path) -> str:
    if path.name in OWN_FOLDER:
        return path.parent.name
    ending = next((ending for ending in ENDINGS if path.name.endswith(ending)), "")
    return path.name.removesuffix(ending)
