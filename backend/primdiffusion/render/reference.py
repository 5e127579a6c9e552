"""The reference marcher: plain torch, readable, differentiable, any device, float32 or float64 (SPEC 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Primitives
from primdiffusion.render.image import Rendering, composite
from primdiffusion.render.lattice import (
    Compositing,
    MarchSettings,
    Span,
    check_scene,
    check_unbatched,
    strides_of,
)

PAIRS_AT_ONCE = 2**20
"""Pairs of rays and boxes per batch; limits memory without changing the result."""
SAMPLES_AT_ONCE = 2**21
"""Samples per batch, about 400 bytes each; limits memory without changing the result."""


def march_reference(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
) -> Rendering:
    """Render `primitives` from `camera` (both unbatched) by the rule of SPEC 4.

    At lattice point t_n = n * spacing each box whose stride s divides n and that contains the point adds the opacity
    a_i = density * window * s * spacing. With "mixed" compositing the point's opacity is sum a_i, its colour
    sum a_i c_i / sum a_i, independent of the order of the boxes; with "index_order" boxes are composited one after the
    other, lowest index first, which differs at the point that saturates a ray. Points are composited front to back by
    `composite`. Boxes with an extent of zero or less contain no points.

    Differentiable in every tensor of `primitives` and `camera`; the number and positions of the samples are treated as
    constant, so the steps of 3.4e-4 (the window's value) at the faces of boxes give no gradient. With gradients, memory
    is proportional to all samples of the image. Raises ValueError as `check_scene` does, if tensors are batched, differ
    in dtype or are narrower than float32, and if a ray takes more than SAMPLES_AT_ONCE samples.
    """
    check_scene(primitives, camera, span)
    check_unbatched(primitives, camera, span)
    _check_dtype([*vars(primitives).values(), camera.intrinsics, camera.world_to_camera])
    origin, directions = camera.rays()
    reach = _reach(camera, span, settings.spacing)
    stride = strides_of(primitives, settings)
    rays_at_once = max(PAIRS_AT_ONCE // max(len(stride), 1), 1)
    blocks = []
    for rays, allowed in zip(directions.flatten(0, 1).split(rays_at_once), reach.split(rays_at_once), strict=True):
        crossings = _crossings(primitives, origin, rays, stride, settings.spacing)
        blocks += [
            _march_rays(primitives, origin, rays[begin:end], allowed[begin:end], settings, stride, part)
            for begin, end, part in _portions(crossings, len(rays))
        ]

    def picture(name: str) -> Tensor:
        return torch.cat([getattr(block, name) for block in blocks]).unflatten(0, (camera.height, camera.width))

    return Rendering(picture("rgb"), picture("alpha"), picture("depth"), picture("first_hit"))


def trilinear(
    voxels: Float[Tensor, "k c d h w"], box: Int[Tensor, "m"], local: Float[Tensor, "m 3"]
) -> Float[Tensor, "m c"]:
    """Interpolate boxes `box` at `local` in [-1, 1]^3, axes W, H, D (SPEC 4).

    Corner-aligned: -1 and 1 are the centres of the outermost voxels, index = (y + 1) / 2 * (size - 1).
    """
    size = torch.tensor(voxels.shape[:-4:-1], device=local.device)
    place = (local + 1) / 2 * (size - 1)
    corner = place.detach().floor().long().clamp_min(0).minimum((size - 2).clamp_min(0))
    far = place - corner
    value = local.new_zeros((len(box), voxels.shape[1]))
    for dx in (0, 1):
        for dy in (0, 1):
            for dz in (0, 1):
                offset = torch.tensor([dx, dy, dz], device=local.device)
                weight = torch.where(offset == 1, far, 1 - far).prod(-1)
                x, y, z = (corner + offset).minimum(size - 1).unbind(-1)
                value = value + weight[:, None] * voxels[box, :, z, y, x]
    return value


def window(local: Float[Tensor, "m 3"]) -> Float[Tensor, "m"]:
    """exp(-8 * sum |y|^8), which fades density towards the faces of a box (SPEC 4)."""
    return torch.exp(-WINDOW_SHARPNESS * local.pow(WINDOW_POWER).sum(-1))


def _check_dtype(tensors: list[Tensor]) -> None:
    dtypes = {tensor.dtype for tensor in tensors}
    if len(dtypes) > 1:
        raise ValueError(f"primitives and camera mix dtypes {sorted(map(str, dtypes))}: convert one with .to()")
    dtype = tensors[0].dtype
    if torch.finfo(dtype).bits < 32:
        raise ValueError(f"{dtype} cannot resolve lattice points a millimetre apart: use float32 or float64")


def _reach(camera: Camera, span: Span | None, spacing: float) -> Float[Tensor, "r 2"]:
    """First and last lattice index of each ray; floats, because the last may be infinite."""
    if span is None:
        no_limit = camera.intrinsics.new_tensor([1.0, torch.inf])
        return no_limit.expand(camera.height * camera.width, 2)
    first, last = (span.near.detach() / spacing).ceil().clamp_min(1), (span.far.detach() / spacing).floor()
    return torch.stack([first.flatten(), last.flatten()], dim=-1)


def _march_rays(
    primitives: Primitives,
    origin: Float[Tensor, "3"],
    directions: Float[Tensor, "r 3"],
    reach: Float[Tensor, "r 2"],
    settings: MarchSettings,
    stride: Int[Tensor, "k"],
    crossings: Crossings,
) -> Rendering:
    ray, box, n = _samples(primitives, origin, directions, reach, stride, settings.spacing, crossings)
    order = torch.argsort(ray * (n.max() + 1 if len(n) else 1) + n, stable=True)  # within a point: index order
    ray, box, n = ray[order], box[order], n[order]

    distance = n.to(origin.dtype) * settings.spacing
    point = origin + distance[:, None] * directions[ray]
    local = _to_local(primitives, box, point)
    rgb_density = torch.cat([primitives.rgb, primitives.density[:, None]], dim=1)
    rgb, density = trilinear(rgb_density, box, local).split((3, 1), dim=-1)
    opacity = density[:, 0] * window(local) * (stride[box].to(distance.dtype) * settings.spacing)

    group, first = GROUPING[settings.compositing](ray, n)
    group_opacity = opacity.new_zeros(len(first)).index_add(0, group, opacity)
    group_rgb = rgb.new_zeros((len(first), 3)).index_add(0, group, opacity[:, None] * rgb)
    return composite(*_rows(ray[first], len(directions), group_opacity, group_rgb, distance[first]))


def _to_local(primitives: Primitives, box: Int[Tensor, "m"], point: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """y = diag(1 / half_extent) R^T (x - T) (SPEC 4)."""
    offset = (point - primitives.position[box])[:, None, :]
    return (offset @ primitives.rotation[box])[:, 0, :] / primitives.half_extent[box]


class Crossings(NamedTuple):
    """Candidate intersections of rays and boxes, ordered by ray, then box."""

    ray: Int[Tensor, "c"]
    box: Int[Tensor, "c"]
    first: Int[Tensor, "c"]
    """First and last lattice point in the box, in units of its stride."""
    last: Int[Tensor, "c"]

    @property
    def count(self) -> Int[Tensor, "c"]:
        """Number of lattice points of each."""
        return self.last - self.first + 1


@torch.no_grad()
def _crossings(
    primitives: Primitives,
    origin: Float[Tensor, "3"],
    directions: Float[Tensor, "r 3"],
    stride: Int[Tensor, "k"],
    spacing: float,
) -> Crossings:
    """Skips boxes with an extent of zero or less."""
    solid = (primitives.half_extent > 0).all(-1).nonzero()[:, 0]
    inverse = 1 / primitives.half_extent[solid]
    p = torch.einsum("ki,kij->kj", origin - primitives.position[solid], primitives.rotation[solid]) * inverse
    q = torch.einsum("ri,kij->rkj", directions, primitives.rotation[solid]) * inverse
    # A tiny slope for rays parallel to a face avoids division by zero; rays with |p| > 1 still miss.
    q = torch.where(q.abs() < 1e-12, torch.full_like(q, 1e-12), q)
    near, far = ((-1 - p) / q), ((1 - p) / q)
    enter, leave = torch.minimum(near, far).amax(-1), torch.maximum(near, far).amin(-1)
    step = stride[solid].to(origin.dtype) * spacing
    # Slightly too wide, for rounding; _samples tests |y| < 1.
    first, last = (enter / step - 1e-3).ceil().clamp_min(1), (leave / step + 1e-3).floor()
    ray, candidate = (first <= last).nonzero(as_tuple=True)
    return Crossings(ray, solid[candidate], first[ray, candidate].long(), last[ray, candidate].long())


def _portions(crossings: Crossings, rays: int) -> Iterator[tuple[int, int, Crossings]]:
    """Batches of rays (begin, end) with at most SAMPLES_AT_ONCE samples, and their crossings with rays renumbered."""
    samples = crossings.ray.new_zeros(rays).index_add(0, crossings.ray, crossings.count).tolist()
    begin, held = 0, 0
    for end in range(1, rays + 1):
        held += samples[end - 1]
        if samples[end - 1] > SAMPLES_AT_ONCE:
            raise ValueError(f"a ray takes {samples[end - 1]:.2g} samples: choose a larger step, or fewer boxes")
        if end == rays or held + samples[end] > SAMPLES_AT_ONCE:
            run = slice(*torch.searchsorted(crossings.ray, crossings.ray.new_tensor([begin, end])).tolist())
            yield begin, end, Crossings(crossings.ray[run] - begin, *(field[run] for field in crossings[1:]))
            begin, held = end, 0


@torch.no_grad()
def _samples(
    primitives: Primitives,
    origin: Float[Tensor, "3"],
    directions: Float[Tensor, "r 3"],
    reach: Float[Tensor, "r 2"],
    stride: Int[Tensor, "k"],
    spacing: float,
    crossings: Crossings,
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Ray, box and lattice index of all samples inside boxes, in this order of precedence."""
    count = crossings.count
    ray, box, first = (field.repeat_interleave(count) for field in (crossings.ray, crossings.box, crossings.first))
    begin = (count.cumsum(0) - count).repeat_interleave(count)
    n = (first + torch.arange(len(begin), device=begin.device) - begin) * stride[box]
    local = _to_local(primitives, box, origin + (n.to(origin.dtype) * spacing)[:, None] * directions[ray])
    inside = (local.abs() < 1).all(-1) & (n >= reach[ray, 0]) & (n <= reach[ray, 1])
    return ray[inside], box[inside], n[inside]


def _by_point(ray: Int[Tensor, "m"], n: Int[Tensor, "m"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "g"]]:
    """Group the samples at one lattice point of a ray; return each sample's group, and each group's first sample."""
    new = torch.ones_like(ray, dtype=torch.bool)
    new[1:] = (ray[1:] != ray[:-1]) | (n[1:] != n[:-1])
    return new.cumsum(0) - 1, new.nonzero()[:, 0]


def _by_sample(ray: Int[Tensor, "m"], n: Int[Tensor, "m"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "g"]]:
    """Put each sample in its own group."""
    every = torch.arange(len(ray), device=ray.device)
    return every, every


GROUPING: dict[Compositing, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "mixed": _by_point,
    "index_order": _by_sample,
}
"""Grouping of the samples that are composited together."""


def _rows(
    ray: Int[Tensor, "g"],
    rays: int,
    opacity: Float[Tensor, "g"],
    rgb: Float[Tensor, "g 3"],
    distance: Float[Tensor, "g"],
) -> tuple[Float[Tensor, "r n"], Float[Tensor, "r n 3"], Float[Tensor, "r n"]]:
    """One row per ray, padded with opacity 0, so that cumulative sums never span rays, where float32 loses digits."""
    count = torch.bincount(ray, minlength=rays)
    slot = torch.arange(len(ray), device=ray.device) - (count.cumsum(0) - count)[ray]
    width = int(count.max()) if len(ray) else 0
    place = (ray, slot)
    return (
        opacity.new_zeros((rays, width)).index_put(place, opacity),
        rgb.new_zeros((rays, width, 3)).index_put(place, rgb),
        opacity.new_zeros((rays, width)).index_put(place, distance),
    )
