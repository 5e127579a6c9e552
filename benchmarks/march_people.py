"""Scenes for the marcher's benchmark: people, poses, crowds, and the same person in fewer or more boxes."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from marching import portrait
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.export.surface import OuterSurface
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart, vertex_normals
from primdiffusion.human import Human, framing, generate, place
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import from_mesh
from primdiffusion.primitives.primitives import GRID, Primitives
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from walk import walk_and_wave

MIDDLE_OF_THE_WALK = 30
SPACING = 1.1
"""Metres between the people of a crowd."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """One picture to draw."""

    group: str
    """The group in the table: person, pose, size, boxes or people."""
    name: str
    primitives: Primitives
    camera: Camera


def standing_person(seed: int = 0) -> Primitives:
    """The default body's 1024 boxes in the rest pose, filled from its mesh with a random checkered texture."""
    return place(checkered_human(seed))


def checkered_human(seed: int = 0, betas: Tensor | None = None, off_the_skin: float = 0.0) -> Human:
    """The default body (`betas` None: the mean body) with a random checkered texture; uses no trained model.

    The texture is on the skin, or on a suit `off_the_skin` metres above it.
    """
    body = default_body()
    betas = torch.zeros(10) if betas is None else betas
    vertices = body.shape(betas).vertices
    suit = OuterSurface(vertices.double().numpy(), body.faces.numpy())
    cells = np.random.default_rng(seed).integers(40, 230, (32, 32, 4), dtype=np.uint8)
    texture = cells.repeat(8, axis=0).repeat(8, axis=1)
    texture[..., 3] = 255
    skin = TexturedPart(
        name="body",
        vertices=suit.vertices + off_the_skin * vertex_normals(*suit),
        faces=body.faces.int().numpy(),
        corner_uv=body.uv[body.uv_faces].double().numpy(),
        texture=texture,
        skin_index=np.zeros((len(vertices), 1), np.int32),
        skin_weight=np.ones((len(vertices), 1)),
    )
    frames = attach(default_anchors(), vertices, body.faces)
    return Human(from_mesh(TexturedMesh((skin,)), frames), betas, {})


def walking() -> BodyPose:
    """A step of the walk in examples/walk.py, the right hand raised."""
    return BodyPose(torch.from_numpy(walk_and_wave(48)[MIDDLE_OF_THE_WALK]).float(), torch.zeros(3))


def contorted(seed: int = 0) -> BodyPose:
    """Every joint rotated at random by about half a radian: limbs cross and boxes overlap."""
    turns = torch.randn((24, 3), generator=torch.Generator().manual_seed(seed)) * 0.3
    return BodyPose(axis_angle_to_matrix(turns), torch.zeros(3))


def in_fewer_boxes(person: Primitives) -> Primitives:
    """A quarter of the boxes, every other row and column of the grid, twice as wide: about the same coverage."""
    index = torch.arange(GRID * GRID).reshape(GRID, GRID)[::2, ::2].flatten()
    remaining = person.map(lambda tensor: tensor[index])
    return dataclasses.replace(remaining, half_extent=remaining.half_extent * torch.tensor([2.0, 2.0, 1.0]))


def in_more_boxes(person: Primitives) -> Primitives:
    """Every box as four, halved along tangent and bitangent, each with 8^3 voxels; the window fades their seams."""
    quarters = []
    for along_t, along_b in itertools.product((-0.5, 0.5), repeat=2):
        offset = person.half_extent * torch.tensor([along_t, along_b, 0.0])
        quarters.append(
            Primitives(
                position=person.position + (person.rotation @ offset[..., None])[..., 0],
                rotation=person.rotation,
                half_extent=person.half_extent * torch.tensor([0.5, 0.5, 1.0]),
                rgb=_half(_half(person.rgb, -1, along_t), -2, along_b),
                density=_half(_half(person.density, -1, along_t), -2, along_b),
            )
        )
    return Primitives.together(quarters)


def _half(voxels: Tensor, axis: int, side: float) -> Tensor:
    """The lower (side < 0) or upper half of an axis, resampled to 8 voxels by linear interpolation."""
    size = voxels.shape[axis]
    position = torch.linspace(0, (size - 1) / 2, size) + (0 if side < 0 else (size - 1) / 2)
    low = position.floor().long().clamp_max(size - 2)
    fraction = (position - low).reshape([-1 if i == axis % voxels.ndim else 1 for i in range(voxels.ndim)])
    near, far = voxels.index_select(axis, low), voxels.index_select(axis, low + 1)
    return near + (far - near) * fraction


def crowd(person: Primitives, count: int) -> Primitives:
    """`count` people in rows of four, facing the camera like the first one."""
    members = []
    for i in range(count):
        shift = torch.tensor([(i % 4 - min(count - 1, 3) / 2) * SPACING, 0.0, -(i // 4) * SPACING])
        members.append(dataclasses.replace(person, position=person.position + shift))
    return Primitives.together(members)


def generated(seeds: tuple[int, ...]) -> list[Human]:
    model = load_checkpoint()
    return [generate(model, seed) for seed in seeds]


def scenes(largest: int, seeds: tuple[int, ...] = (1, 2)) -> Iterator[Scene]:
    """All scenes of the table, with pictures up to `largest` pixels a side."""
    checkered = checkered_human()
    person, view = place(checkered), portrait(512)
    for size in (256, 512, 1024, 2048):
        if size <= largest:
            yield Scene("size", f"{size} x {size}", person, portrait(size))
    for human, seed in zip(generated(seeds), seeds, strict=True):
        standing = place(human)
        yield Scene("person", f"generated, seed {seed}", standing, framing(standing))
    for name, pose in (("walking", walking()), ("contorted", contorted())):
        posed = place(checkered, pose)
        yield Scene("pose", name, posed, framing(posed))
    yield Scene("boxes", "256 boxes", in_fewer_boxes(person), view)
    yield Scene("boxes", "1024 boxes", person, view)
    yield Scene("boxes", "4096 boxes", in_more_boxes(person), view)
    for count in (1, 2, 4, 8, 16):
        group = crowd(person, count)
        yield Scene("people", f"{count} people" if count > 1 else "1 person", group, framing(group))
