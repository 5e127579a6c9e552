"""Person components: directions in latents that people have in common, found for each part of the body."""

from __future__ import annotations

import dataclasses
import functools

from jaxtyping import Float, Int
from torch import Tensor, cat, einsum, zeros_like

from primdiffusion.geometry.records import TensorRecord


@dataclasses.dataclass(frozen=True)
class PersonComponents(TensorRecord):
    """Latents [C, H, W] on K = H*W cells as P parts of N components (R = P*N), and a rest orthogonal to these."""

    mean: Float[Tensor, "c h w"]
    basis: Float[Tensor, "n k d"]
    """Components, orthonormal in each part, in the order of their variance: [j, i] is what component j of a cell's
    part adds to its d leading channels. Cells are in the order of their parts, `part.argsort(stable=True)`."""
    part: Int[Tensor, "k"]
    """Part of each cell, equal to its own mirror image; the last one is the head."""
    parity: Float[Tensor, "r"]
    """Sign of each coefficient in the mirror image of a person."""

    def split(self, z: Float[Tensor, "b c h w"], signal: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
        """Person coefficients [b, R] and rest [b, C, H, W] of latents whose mean is scaled by `signal` [b, 1, 1, 1]."""
        centred = z - signal * self.mean
        coefficients = self._along(centred)
        return coefficients, centred - self.picture(coefficients)

    def join(self, coefficients: Float[Tensor, "b r"], rest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Latents of person coefficients and rest; the rest's share along the components is removed."""
        return self.mean + rest + self.picture(coefficients - self._along(rest))

    def outside(self, z: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The part orthogonal to the person components of latents without the mean."""
        return z - self.picture(self._along(z))

    def picture(self, coefficients: Float[Tensor, "b r"]) -> Float[Tensor, "b c h w"]:
        """Return the contribution of person coefficients to latents, without the mean."""
        own = coefficients.unflatten(1, (-1, len(self.basis))).unbind(1)
        drawn = cat([part @ basis.flatten(1) for part, basis in zip(own, self.bases(), strict=True)], dim=1)
        channels = self.basis.shape[2]
        picture = coefficients.new_zeros((len(coefficients), *self.mean.flatten(1).shape))
        picture[:, :channels, self._order] = drawn.unflatten(1, (-1, channels)).mT
        return picture.unflatten(2, self.mean.shape[1:])

    def _along(self, z: Float[Tensor, "b c h w"]) -> Float[Tensor, "b r"]:
        cells = z.flatten(2)[:, : self.basis.shape[2], self._order].mT
        own = cells.split([basis.shape[1] for basis in self.bases()], dim=1)
        return cat([part.flatten(1) @ basis.flatten(1).T for part, basis in zip(own, self.bases(), strict=True)], dim=1)

    @property
    def _order(self) -> Int[Tensor, "k"]:
        return self.part.argsort(stable=True)

    def bases(self) -> tuple[Tensor, ...]:
        """The components of each part [n, cells, d]."""
        return self.basis.split(self._cells, dim=1)

    @functools.cached_property
    def _cells(self) -> list[int]:
        """Cells of each part; waits for the device."""
        return self.part.bincount().tolist()

    def picture_variance(self, variance: Float[Tensor, "r"]) -> Float[Tensor, "c h w"]:
        """Variance of `picture` for independent coefficients of these variances."""
        own = variance.unflatten(0, (-1, len(self.basis)))
        drawn = cat([einsum("nkd,n->kd", basis.square(), part) for part, basis in zip(own, self.bases(), strict=True)])
        picture = zeros_like(self.mean).flatten(1)
        picture[: drawn.shape[1], self._order] = drawn.T
        return picture.view_as(self.mean)
