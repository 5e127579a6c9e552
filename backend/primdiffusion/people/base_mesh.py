"""MakeHuman's full base mesh (hm08) as a function of the default body's betas; clothes, hair and eyes are fitted to it.

Asset files (.mhclo) refer to its 19,158 vertices by index; part of them is the visible body, the rest are helper
vertices around it. Rest pose, axes and betas are the default body's (`body.model.default_body`).

The ten betas describe height, weight and age but do not vary facial features, so faces are varied by small smooth
displacements. Each move is a Gaussian displacement around a point and its mirror image, a few millimetres at most;
eyes, brows and hair are fitted to the base mesh and follow. Some moves have a nonzero mean: the pack's neutral face
frowns and its lips are parted.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources

import numpy as np
from jaxtyping import Float, Int

from primdiffusion.files.arrays import array_names, read_arrays


@dataclasses.dataclass(frozen=True, eq=False)
class BaseMesh:
    """A linear shape model of the base mesh. Its arrays are shared: never write to them."""

    template: Float[np.ndarray, "19158 3"]
    """Vertices at zero betas, metres, float64."""
    shape_basis: Float[np.ndarray, "19158 3 10"]
    """Displacement per unit of each beta, metres; within 0.1 mm of the default body's at plausible betas."""
    joint_index: Int[np.ndarray, "19158 4"]
    """Joints (of 24) that move each vertex."""
    joint_weight: Float[np.ndarray, "19158 4"]
    """Skin weights of these joints; rows sum to one."""
    faces: Int[np.ndarray, "F 3"]
    """Faces of the visible body, indexing the base mesh, in the order of the default body's faces."""
    uv: Float[np.ndarray, "T 2"]
    """Texture coordinates of the skin, v up."""
    uv_faces: Int[np.ndarray, "F 3"]
    """Index into `uv` of each face's corners."""
    rest_from_native: Float[np.ndarray, "24 3 3"]
    """Rotation of each joint from MakeHuman's own pose (arms lowered) to the rest pose, world axes.

    Offsets in .mhclo files are vectors in MakeHuman's pose: rotate them by the blend of these before adding them.
    """
    sample_betas: Float[np.ndarray, "N 10"]
    """Betas of the adults that the shape space was fitted to; mean 0, standard deviation 1 in each component."""
    sample_phenotypes: Float[np.ndarray, "N 11"]
    """Their MakeHuman parameters in [0, 1]; columns named by `phenotype_names` (gender 1 is female)."""
    phenotype_names: tuple[str, ...]

    def vertices(self, betas: Float[np.ndarray, "10"]) -> Float[np.ndarray, "19158 3"]:
        """Vertices at given betas, metres, float64."""
        return self.template + self.shape_basis[..., : len(betas)] @ np.asarray(betas, np.float64)

    @property
    def corner_uv(self) -> Float[np.ndarray, "F 3 2"]:
        """Texture coordinates of every corner of `faces`."""
        return self.uv[self.uv_faces]


@functools.cache
def load_base_mesh() -> BaseMesh:
    """Load the base mesh that ships with the package."""
    with importlib.resources.as_file(importlib.resources.files("primdiffusion.people") / "data/hm08.npz") as path:
        f = read_arrays(path, array_names(path))
        weight = f["joint_weight"].astype(np.float64)
        return BaseMesh(
            template=f["template"].astype(np.float64),
            shape_basis=f["shape_basis"].astype(np.float64),
            joint_index=f["joint_index"].astype(np.int64),
            joint_weight=weight / weight.sum(1, keepdims=True),
            faces=f["faces"].astype(np.int64),
            uv=f["uv"].astype(np.float64),
            uv_faces=f["uv_faces"].astype(np.int64),
            rest_from_native=f["rest_from_native"],
            sample_betas=f["sample_betas"].astype(np.float64),
            sample_phenotypes=f["sample_phenotypes"].astype(np.float64),
            phenotype_names=tuple(str(name) for name in f["phenotype_names"]),
        )


MOUTH_HEIGHT = 0.4072
"""Height at which the average face's lips meet, metres in the rest pose."""
LIP_REACH, LIP_WIDTH = 0.0045, 0.027
"""Falloff of the closing of the lips around their rims, and half the width of the mouth, metres."""
LIMIT = 2.0
"""Moves are clipped to this many standard deviations from their mean."""


@dataclasses.dataclass(frozen=True)
class Move:
    """A displacement; `deviation` and `mean` are in millimetres, or relative for `stretch`."""

    at: tuple[float, float, float]
    """Centre on the left half of the average face, metres."""
    radius: float
    """Standard deviation of the Gaussian, metres."""
    along: tuple[float, float, float]
    """Unit direction on the left; x is mirrored on the right."""
    deviation: float
    mean: float = 0.0
    stretch: bool = False
    """Scales the region about its centre (and mirrored centre) instead of shifting it."""


MOVES = (
    Move((0, 0.438, 0.172), 0.014, (1, 0, 0), 0.13, stretch=True),  # width of the nose
    Move((0, 0.438, 0.176), 0.012, (0, 1, 0), 1.6),  # its length
    Move((0, 0.440, 0.176), 0.013, (0, 0, 1), 1.6),  # its tip
    Move((0, 0.466, 0.166), 0.012, (0, 0, 1), 1.5),  # its bridge
    Move((0.045, 0.385, 0.115), 0.030, (1, 0, 0), 2.6),  # jaw
    Move((0, 0.368, 0.155), 0.022, (0, 1, 0), 2.6),  # height of the chin
    Move((0, 0.372, 0.160), 0.018, (0, 0, 1), 2.0),  # how far it stands out
    Move((0, MOUTH_HEIGHT, 0.167), 0.012, (0, 1, 0), 0.16, stretch=True),  # fullness of the lips
    Move((0, MOUTH_HEIGHT, 0.165), 0.018, (1, 0, 0), 0.07, stretch=True),  # width of the mouth
    Move((0.024, 0.408, 0.156), 0.009, (0, 1, 0), 0.7, mean=1.3),  # corners of the mouth
    Move((0.018, 0.491, 0.160), 0.010, (0, 1, 0), 0.8, mean=1.6),  # inner ends of the brows
    Move((0.046, 0.492, 0.146), 0.012, (0, 1, 0), 0.9, mean=-1.0),  # outer ends
    Move((0.031, 0.478, 0.150), 0.020, (1, 0, 0), 0.9),  # distance of the eyes
    Move((0.050, 0.440, 0.135), 0.022, (0.8, 0, 0.6), 2.0),  # cheeks
    Move((0, 0.540, 0.150), 0.035, (0, 0, 1), 2.0),  # forehead
)


def draw_face(draws: np.random.Generator) -> Float[np.ndarray, " M"]:
    """Draw the amount of each move."""
    deviation = np.array([move.deviation for move in MOVES])
    mean = np.array([move.mean for move in MOVES])
    return mean + deviation * np.clip(draws.standard_normal(len(MOVES)), -LIMIT, LIMIT)


def with_face(
    vertices: Float[np.ndarray, "B 3"], base: BaseMesh, amounts: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "B 3"]:
    """Apply moves and close the lips of a base mesh."""
    fields, closing = _fields(base)
    return vertices + closing + np.einsum("m,mvc->vc", amounts, fields)


@functools.lru_cache(maxsize=2)
def _fields(base: BaseMesh) -> tuple[Float[np.ndarray, "M B 3"], Float[np.ndarray, "B 3"]]:
    """Displacement per unit of each move, and the displacement that closes the lips."""
    fields = [sum(_bell(move, base.template, side) for side in _sides(move)) for move in MOVES]
    return np.stack(fields), _closed_lips(base)


def _sides(move: Move) -> tuple[int, ...]:
    return (1, -1) if move.at[0] else (1,)


def _bell(move: Move, vertices: Float[np.ndarray, "B 3"], side: int) -> Float[np.ndarray, "B 3"]:
    mirror = np.array([side, 1, 1])
    away = vertices - np.array(move.at) * mirror
    weight = np.exp(-0.5 * (away**2).sum(1) / move.radius**2)[:, None]
    along = np.array(move.along) * mirror
    return weight * (away * along if move.stretch else 1e-3 * along)


def _closed_lips(base: BaseMesh) -> Float[np.ndarray, "B 3"]:
    """Displacement that moves both rims of the mouth (boundary edges of the skin) halfway, with a falloff around."""
    edges = np.sort(base.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    rim = np.unique(unique[count == 1])
    place = base.template[rim]
    rim = rim[(np.abs(place[:, 1] - MOUTH_HEIGHT) < 0.006) & (np.abs(place[:, 0]) < LIP_WIDTH) & (place[:, 2] > 0.13)]
    place = base.template[rim]
    upper = place[:, 1] > np.interp(place[:, 0], *_middle_line(place))
    target = np.empty(len(rim))
    for half, other in ((upper, ~upper), (~upper, upper)):
        order = np.argsort(place[other, 0])
        opposite = np.interp(place[half, 0], place[other, 0][order], place[other, 1][order])
        target[half] = (opposite + place[half, 1]) / 2
    move = np.zeros_like(base.template)
    total = np.zeros(len(base.template))
    for vertex, height in zip(rim, target, strict=True):
        side = np.sign(base.template[vertex, 1] - height)
        away = base.template - base.template[vertex]
        same = np.sign(base.template[:, 1] - height) == side
        weight = same * np.exp(-0.5 * (away**2).sum(1) / LIP_REACH**2) ** 2
        move[:, 1] += weight * (height - base.template[vertex, 1])
        total += weight
    reach = np.zeros(len(base.template))
    for vertex in rim:
        away = ((base.template - base.template[vertex]) ** 2).sum(1)
        reach = np.maximum(reach, np.exp(-0.5 * away / LIP_REACH**2))
    move = reach[:, None] * move / np.maximum(total, 1e-9)[:, None]
    move[rim, 1] = target - place[:, 1]
    return move


def _middle_line(rim: Float[np.ndarray, "R 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Sample points along x, and the height halfway between the lips at each."""
    x = np.linspace(-LIP_WIDTH, LIP_WIDTH, 13)
    near = [np.abs(rim[:, 0] - at) < 0.004 for at in x]
    height = [(rim[here, 1].min() + rim[here, 1].max()) / 2 if here.any() else MOUTH_HEIGHT for here in near]
    return x, np.array(height)
