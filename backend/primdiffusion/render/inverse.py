"""Inverse rendering: fit colours and densities to images by damped Gauss-Newton on the CPU.

Minimises over the voxels z = (sRGB-encoded colour, density / full density), for fixed boxes,

    sum over pixels of w |J (z - z_0) - r|^2  +  pull |z - z_start|^2  +  smoothness |grad (z - z_start)|^2

where r is the residual of the image of z_0 and J its derivative (`cpu_linear`), both in encoded colours, so that dark
and bright humans count alike. The slope of the encoding is constant, taken at the target's pixels and the start's
voxels. A step marches all images, stores J and solves by a few iterations of conjugate gradients. Early stopping and
the two penalties suppress what the images do not determine, so that other images of the same human give nearly the same
voxels. Results are deterministic on one machine.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from primdiffusion.formats.requests import Count, NotNegative
from primdiffusion.formats.schema import Checked
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.primitives.primitives import Payload, Primitives, S
from primdiffusion.render.cpu.linear import (
    ColourMatrix,
    PictureJacobian,
    add_colours_transposed,
    add_diagonal,
    add_transposed,
    apply,
    apply_colours,
    linearise,
)
from primdiffusion.render.image import PosedView

BACKGROUND = float(decode_srgb(torch.tensor(0.5)))
"""Linear grey behind target and image, in contrast to dark and light humans."""


Dot = Callable[[ndarray, ndarray], Any]
"""A scalar product of voxels."""


@dataclasses.dataclass(frozen=True)
class InverseSettings(Checked):
    """Iterations and penalties of the fit."""

    steps: Count = 3
    """Gauss-Newton steps. The last uses all images, earlier ones every other image in turn."""
    iterations: Count = 6
    """Iterations of conjugate gradients per step; more would fit noise."""
    colour_iterations: Count = 7
    """Iterations of conjugate gradients for colours alone, which take one step; each column has its own lengths."""
    pull: NotNegative = 0.03
    """Weight of the distance from the start, in units of the mean diagonal of J^T W J."""
    smoothness: NotNegative = 0.1
    """Weight of differences between neighbouring voxels of a box, in the same units."""
    opacity_weight: NotNegative = 0.3
    """Weight of square errors of alpha relative to those of encoded colours."""
    darkest: NotNegative = 0.02
    """Linear intensity below which the slope of sRGB is constant; it is steepest at black."""


def fit_payload(
    start: Payload,
    targets: Sequence[PosedView],
    full_density: float,
    settings: InverseSettings = InverseSettings(),
) -> Payload:
    """Fit a payload to the targets, from `start`: colours in [0, 1], densities from 0 to `full_density` (1/m).

    Delta scales do not change. Costs about 0.1 s and 15 MB per image of 176 x 176 pixels in each step.

    Raises:
        ValueError: there are no targets, they are sRGB bytes, or `start` is a batch.
    """
    _check(start, targets)
    first = _voxels(start)
    z, scale = (
        first,
        np.concatenate([_linear_unit(first[:, :3], settings), np.full_like(first[:, 3:], full_density)], 1),
    )
    limit = np.array([1, 1, 1, full_density], np.float32)

    def closer(z: ndarray, seen: Sequence[PosedView]) -> ndarray:
        """After a step in these views; their matrices are large, and gone before the next."""
        views = [LinearisedView.of(target, _payload(z, start), settings) for target in seen]
        gradient, diagonal = np.zeros_like(z), np.zeros_like(z)
        jacobians, alpha_free = [view.jacobian for view in views], [view.alpha_free for view in views]
        add_transposed(jacobians, [view.weight * view.residual for view in views], alpha_free, gradient)
        for view in views:
            add_diagonal(view.jacobian, view.weight, view.alpha_free, diagonal)
        gradient, diagonal = gradient * scale, diagonal * scale**2
        unit = _mean_diagonal(diagonal)
        change = (z - first) / scale
        gradient -= unit * (np.float32(settings.pull) * change + np.float32(settings.smoothness) * laplacian(change))
        held = ((z <= 0) & (gradient < 0)) | ((z >= limit) & (gradient > 0))
        penalty = _Penalty(unit, settings, diagonal, held)
        return z + scale * conjugate_gradients(_curvature(views, scale), penalty, gradient, settings.iterations, _dot)

    for number in range(settings.steps):
        last = number == settings.steps - 1
        z = closer(z.clip(0, limit), targets if last else targets[number % 2 :: 2] or targets)
    return _payload(z.clip(0, limit), start)


def fit_colours(
    starts: Sequence[Payload],
    density: Payload,
    targets: Sequence[Sequence[PosedView]],
    settings: InverseSettings = InverseSettings(),
) -> list[Payload]:
    """Fit the colours of several colourings of one geometry, with the densities of `density`.

    `starts` are their payloads, `targets[i]` their images, all from the same cameras in the same order. They share
    marches and matrices, so that several cost little more than one.

    Raises:
        ValueError: as `fit_payload`, or colourings have different numbers of targets.
    """
    for start, own in zip(starts, targets, strict=True):
        _check(start, own)
    if len({len(own) for own in targets}) != 1:
        raise ValueError(f"colourings have {[len(own) for own in targets]} targets: give each the same cameras")
    first = np.concatenate([_voxels(start)[:, :3] for start in starts], axis=1)
    z, scale = first.clip(0, 1), _linear_unit(first, settings)
    views = []
    for same_camera in zip(*targets, strict=True):
        views.append(_ColourView.of(same_camera, density, z, settings))
    gradient, diagonal = np.zeros_like(z), np.zeros_like(z)
    matrices = [view.matrix for view in views]
    add_colours_transposed(matrices, [view.weight * view.residual for view in views], gradient)
    for view in views:
        view.matrix.add_diagonal(view.weight, diagonal)
    gradient, diagonal = gradient * scale, diagonal * scale**2
    unit = _mean_diagonal(diagonal)
    held = ((z <= 0) & (gradient < 0)) | ((z >= 1) & (gradient > 0))
    penalty = _Penalty(unit, settings, diagonal, held)

    def curvature(x: ndarray) -> ndarray:
        out = np.zeros_like(x)
        pixels = apply_colours(matrices, x * scale)
        weighted = [view.weight * one for view, one in zip(views, pixels, strict=True)]
        add_colours_transposed(matrices, weighted, out)
        return out * scale

    z = (
        z + scale * conjugate_gradients(curvature, penalty, gradient, settings.colour_iterations, _dot_by_column)
    ).clip(0, 1)
    return [
        Payload(_rgb(z[:, 3 * i : 3 * i + 3], start), density.density, density.delta_scale)
        for i, start in enumerate(starts)
    ]


@dataclasses.dataclass(frozen=True, eq=False)
class LinearisedView:
    """A target, linearised at the current voxels: with changes x of voxels, it differs by residual - jacobian x."""

    jacobian: PictureJacobian
    residual: Float32[ndarray, "r 4"]
    """Linear RGB over BACKGROUND, and alpha."""
    weight: Float32[ndarray, "r 4"]
    """Weights of squared residuals; those of a target's pixels sum to a mean over its figure, of encoded colours."""
    alpha_free: Float32[ndarray, "r"]
    """1 where alpha follows density, 0 where the ray is opaque."""

    @classmethod
    def of(cls, target: PosedView, payload: Payload, settings: InverseSettings) -> LinearisedView:
        """Linearise at a payload on the CPU."""
        rendering, jacobian = linearise(Primitives.place(target.frames, payload), target.camera, BACKGROUND)
        rgb, alpha = rendering.rgb.numpy().reshape(-1, 3), rendering.alpha.numpy().reshape(-1, 1)
        wanted, wanted_alpha = _over_background(target)
        residual = np.concatenate([wanted - (rgb + (1 - alpha) * BACKGROUND), wanted_alpha - alpha], axis=1)
        weight = np.concatenate(
            [_encoding_slope(wanted, settings.darkest) ** 2, np.full_like(alpha, settings.opacity_weight)], axis=1
        )
        weight *= target.weight / max(1.0, float(wanted_alpha.sum()))
        return cls(
            jacobian, residual.astype(np.float32), weight.astype(np.float32), (alpha[:, 0] < 1).astype(np.float32)
        )


def _curvature(views: Sequence[LinearisedView], scale: ndarray) -> Callable[[ndarray], ndarray]:
    """x -> J^T W J x over all views, in the units of `scale`."""

    jacobians, alpha_free = [view.jacobian for view in views], [view.alpha_free for view in views]

    def product(x: ndarray) -> ndarray:
        out = np.zeros_like(x)
        pixels = apply(jacobians, x * scale, alpha_free)
        weighted = [view.weight * one for view, one in zip(views, pixels, strict=True)]
        add_transposed(jacobians, weighted, alpha_free, out)
        return out * scale

    return product


@dataclasses.dataclass(frozen=True, eq=False)
class _ColourView:
    """The targets of all colourings from one camera."""

    matrix: ColourMatrix
    residual: Float32[ndarray, "r c"]
    weight: Float32[ndarray, "r c"]

    @classmethod
    def of(cls, targets: Sequence[PosedView], density: Payload, z: ndarray, settings: InverseSettings) -> _ColourView:
        target = targets[0]
        rendering, jacobian = linearise(Primitives.place(target.frames, density), target.camera, BACKGROUND)
        matrix, alpha = ColourMatrix.of(jacobian), rendering.alpha.numpy().reshape(-1, 1)
        drawn = apply_colours([matrix], z)[0] + (1 - alpha) * BACKGROUND
        wanted = np.concatenate([_over_background(one)[0] for one in targets], axis=1)
        weight = _encoding_slope(wanted, settings.darkest) ** 2
        weight *= target.weight / max(1.0, float(target.rgba[..., 3].numpy().sum()))
        return cls(matrix, (wanted - drawn).astype(np.float32), weight.astype(np.float32))


@dataclasses.dataclass(frozen=True, eq=False)
class _Penalty:
    """The penalties, the preconditioner and the active bounds."""

    unit: Float32[ndarray, "c"]
    """Scale of pull and smoothness."""
    settings: InverseSettings
    diagonal: Float32[ndarray, "v c"]
    """Diagonal of the image term, for the preconditioner."""
    held: Bool[ndarray, "v c"]
    """Voxels fixed at a bound, because the gradient points beyond it."""


def conjugate_gradients(curvature, penalty: _Penalty, gradient: ndarray, iterations: int, dot: Dot) -> ndarray:
    """Iterate Jacobi-preconditioned conjugate gradients for (curvature + penalty) x = gradient.

    `dot` gives the steps: one for all columns, or, by columns that do not depend on each other, their own.
    """
    settings, unit = penalty.settings, penalty.unit
    own = settings.pull + 6 * settings.smoothness
    inverse = np.where(penalty.held, 0, 1 / np.maximum(penalty.diagonal + unit * own, 1e-30))
    inverse = inverse.astype(np.float32)
    residual = np.where(penalty.held, 0, gradient).astype(np.float32)
    x = np.zeros_like(residual)
    preconditioned = inverse * residual
    direction = preconditioned.copy()
    energy = dot(residual, preconditioned)
    for _ in range(iterations):
        if not np.any(energy > 0):
            break
        held_back = np.float32(settings.pull) * direction + np.float32(settings.smoothness) * laplacian(direction)
        curved = curvature(direction) + unit * held_back
        curved[penalty.held] = 0
        length = np.float32(energy / np.maximum(dot(direction, curved), 1e-30))
        x += length * direction
        residual = residual - length * curved
        preconditioned = inverse * residual
        before, energy = energy, dot(residual, preconditioned)
        direction = preconditioned + np.float32(energy / np.maximum(before, 1e-30)) * direction
    return x


def laplacian(x: Float32[ndarray, "v c"]) -> Float32[ndarray, "v c"]:
    """Sum of the differences to the neighbours of a voxel in its box."""
    grid = x.reshape(-1, S, S, S, x.shape[1])
    out = np.zeros_like(grid)
    for axis in (1, 2, 3):
        difference = np.diff(grid, axis=axis)
        later: list[slice] = [slice(None)] * 5
        earlier: list[slice] = [slice(None)] * 5
        later[axis], earlier[axis] = slice(1, None), slice(None, -1)
        out[tuple(later)] += difference
        out[tuple(earlier)] -= difference
    return out.reshape(x.shape)


def _check(start: Payload, targets: Sequence[PosedView]) -> None:
    if not targets:
        raise ValueError("there are no images to fit: give at least one target")
    if not all(target.rgba.is_floating_point() for target in targets):
        raise ValueError("the images to fit are sRGB bytes: give linear colours, premultiplied by alpha")
    start.validate()
    if start.density.ndim != 4:
        raise ValueError(f"the start is a batch {tuple(start.density.shape[:-4])}: give one human")


def _over_background(target: PosedView) -> tuple[ndarray, ndarray]:
    """Colours over the background, and alpha; one row per pixel."""
    rgba = target.rgba.numpy().reshape(-1, 4)
    return rgba[:, :3] + (1 - rgba[:, 3:]) * BACKGROUND, rgba[:, 3:]


def _encoding_slope(linear: ndarray, darkest: float) -> ndarray:
    """d(sRGB-encoded) / d(linear)."""
    linear = np.maximum(linear, darkest)
    power = 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1 / 2.4 - 1)
    return np.where(linear <= 0.0031308, 12.92, power).astype(np.float32)


def _linear_unit(colours: ndarray, settings: InverseSettings) -> ndarray:
    """Change of linear colour per unit of encoded colour, at these colours."""
    return 1 / _encoding_slope(colours.clip(0, 1), settings.darkest)


def _mean_diagonal(diagonal: ndarray) -> ndarray:
    """Mean over visible voxels, of each colouring's three columns together and of density (column 3 of 4)."""
    unit = np.ones(diagonal.shape[1], np.float32)
    for first in range(0, len(unit), 3):
        columns = diagonal[:, first : first + 3]
        seen = columns[columns > 0]
        unit[first : first + 3] = seen.mean() if seen.size else 1.0
    return unit


def _dot(a: ndarray, b: ndarray) -> np.float64:
    return (a * b).sum(dtype=np.float64)


def _dot_by_column(a: ndarray, b: ndarray) -> Float64[ndarray, "c"]:
    return (a * b).sum(0, dtype=np.float64)


def _voxels(payload: Payload) -> Float32[ndarray, "v 4"]:
    """Colour and density of every voxel, box by box."""
    rgb = payload.rgb.detach().float().movedim(1, -1).reshape(-1, 3)
    density = payload.density.detach().float().reshape(-1, 1)
    return np.ascontiguousarray(torch.cat([rgb, density], dim=1).numpy())


def _payload(z: Float32[ndarray, "v 4"], like: Payload) -> Payload:
    density = torch.from_numpy(np.ascontiguousarray(z[:, 3])).reshape(like.density.shape)
    return Payload(_rgb(z[:, :3], like), density, like.delta_scale)


def _rgb(colours: Float32[ndarray, "v 3"], like: Payload) -> torch.Tensor:
    boxes = len(like.density)
    return torch.from_numpy(np.ascontiguousarray(colours.reshape(boxes, -1, 3).transpose(0, 2, 1))).reshape(
        like.rgb.shape
    )
