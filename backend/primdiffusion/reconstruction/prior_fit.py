"""The fit of humans to pictures by the person prior of a diffusion model.

It finds the person coefficients c of the model that explain the pictures. Near an estimate a picture is linear in c
(`render.cpu.linear`), and the people of one outfit are Gaussian, so the posterior mean of c
has a closed form; a few Gauss-Newton steps repeat it, for each outfit and then for each hair style of the outfits that
explain the pictures best. What no picture shows thus has the most probable colours and shape given what they show: the
back of a jacket belongs to its front. The network draws what c cannot. Then the voxels themselves are fitted to the
pictures (`render.inverse`), which keeps the others close to that human.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from numpy import ndarray
from torch import Tensor

from primdiffusion.capture.reader import Views
from primdiffusion.diffusion.codec import VOXEL_VALUES, CellCodec, LinearCodec, payload_from_cells
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import GaussianOfKinds, PersonPrior
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import ddim, gaussian_noise
from primdiffusion.diffusion.surfaces import BLACK, SURELY, Surfaces
from primdiffusion.formats import requests
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.primitives.primitives import Frames, Payload, Primitives, S
from primdiffusion.render.cpu.linear import apply_to_codes
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import InverseSettings, LinearisedView, fit_payload
from primdiffusion.render.march import march

STARTING_SIDE, STARTING_STEPS = 96, 3
"""Largest side of the pictures, pixels, and Gauss-Newton steps with all people, after which outfits are chosen."""


class SearchStage(NamedTuple):
    """A stage of the search for the people nearest to a human: outfits, then outfits with hair styles."""

    candidates: int
    """Number of those that explain the pictures best by the linearisation before."""
    side: int
    """Largest side of the pictures, pixels."""
    steps: int
    """Gauss-Newton steps of each."""


OUTFITS, HEADS = SearchStage(candidates=6, side=96, steps=2), SearchStage(candidates=4, side=128, steps=2)
BEST_OUTFITS = 2
"""Outfits that are tried with their hair styles."""
DIRECTIONS = 128
"""Leading directions of an outfit's people in which its coefficients are sought."""
SEARCH_VIEWS = 2
"""Views, evenly spaced, that the search looks at."""
STEPS = 2
"""Gauss-Newton steps from there, in all views."""
FIT_STEPS = STEPS + 1
"""Number of times that `PriorFit.fit` reports."""
OBSERVATIONS = 150.0
"""Number of independent pixels that a view counts as. What person components cannot draw differs over patches, not over
pixels; more would fit them to noise, fewer would ignore the view."""
PIXEL_STD = 0.08
"""Standard deviation of such a pixel from what the best coefficients draw, in encoded colour."""
PULL, SMOOTHNESS = 2.0, 1.0
"""Penalties of the voxels' fit to one view (`InverseSettings`), which each further view outweighs more. As small as for
many views, they would let one view change what only other sides show."""
FEWEST_PIXELS = 20
"""Pixels of hair from which its colour is read."""
COARSE_SIDE, FINE_SIDE = 176, 256
"""Largest sides of the pictures for coefficients and for voxels, pixels."""


Kind = tuple[int, int | None]
"""An outfit and a head, or all heads."""


class PosteriorEstimate(NamedTuple):
    """People of one outfit, or of one outfit and head, or all people (None), after a Gauss-Newton step."""

    group: int | None
    head: int | None
    weights: Float[Tensor, "n"]
    """Posterior mean of their `GaussianOfKinds`, or a draw, for pictures linearised at the weights before the step."""
    evidence: float
    """Logarithm of the probability of these pictures."""


@dataclasses.dataclass(frozen=True)
class PriorFit:
    """Fits humans to pictures, by the person components of a diffusion model and their prior."""

    denoiser: PersonDenoiser
    chain: list[int]
    """Descending t at which the denoiser draws."""
    prior: PersonPrior
    codec: LinearCodec
    full_density: float
    decode: Callable[[Tensor], Payload]
    """Decoder of the model, whose surfaces have one colour each, on the CPU."""
    surfaces: Surfaces | None
    _latest: list = dataclasses.field(default_factory=lambda: [None, None], init=False, repr=False)

    @classmethod
    @functools.lru_cache(maxsize=1)  # the directions of all people take a second
    def of(cls, model: DiffusionModel) -> PriorFit:
        """Components of the model's person prior. Raises ValueError if it has none, or is not of the default body."""
        if not isinstance(model.denoiser, PersonDenoiser) or not isinstance(model.codec, CellCodec):
            raise ValueError("the model has no person components: give a checkpoint of the default architecture")
        if model.body_setup is not None:
            raise ValueError(
                f"the model belongs to the body {model.body_setup.files.smpl.path}: give one of the default body"
            )
        chain = model.chain(model.schedule.length, requests.Sampling.steps)
        codec = model.codec.codec.to("cpu")
        prior, device = model.denoiser.prior.to("cpu"), model.device
        surfaces = None if model.surfaces is None else model.surfaces.to("cpu")

        def decode(x0: Tensor) -> Payload:
            return model.decode(x0.to(device)).to("cpu")

        return cls(model.denoiser, chain, prior, codec, model.full_density, decode, surfaces)

    @property
    def start_steps(self) -> int:
        """Number of times that `start` reports."""
        groups = len(self.prior.log_weight)
        heads = sum(sorted(len(self.prior.heads_of(group)) for group in range(groups))[-BEST_OUTFITS:])
        outfit_steps = min(OUTFITS.candidates, groups) * OUTFITS.steps
        return STARTING_STEPS + outfit_steps + min(HEADS.candidates, heads) * HEADS.steps

    @functools.cached_property
    def _voxel_basis(self) -> Float32[ndarray, "b 512 4 c"]:
        return self.codec.voxel_basis(self.prior.basis.shape[2]).contiguous().numpy()

    def _kinds(self, group: int | None, head: int | None) -> tuple[GaussianOfKinds, Float32[ndarray, "k d w"]]:
        """People of an outfit and head, and channels of each box by their weights; those asked for last are kept."""
        if (group, head) != self._latest[0]:
            self._forget()
            everyone = group is None
            kinds = self._everyone if everyone else self.prior.gaussian_of(group, head).leading(DIRECTIONS)
            self._latest[:] = [(group, head), self._codes_of(kinds)]
        return self._latest[1]

    def _forget(self) -> None:
        """Let go of the latest kinds, whose channels are 50 MB."""
        self._latest[:] = [None, None]

    @functools.cached_property
    def _everyone(self) -> GaussianOfKinds:
        return self.prior.gaussian_of_all(DIRECTIONS)

    def _codes_of(self, kinds: GaussianOfKinds) -> tuple[GaussianOfKinds, Float32[ndarray, "k d w"]]:
        codes = torch.empty(*self.prior.basis.shape[1:], len(kinds.factor))
        by_part = kinds.factor.unflatten(1, (-1, len(self.prior.basis))).unbind(1)
        for part, (basis, own) in enumerate(zip(self.prior.bases(), by_part, strict=True)):
            codes[self.prior.part == part] = (basis.flatten(1).T @ own.T).unflatten(0, basis.shape[1:])
        return kinds, codes.numpy()

    def coefficients(self, estimate: PosteriorEstimate) -> Float[Tensor, "r"]:
        """Person coefficients of an estimate."""
        kinds, _ = self._kinds(estimate.group, estimate.head)
        return kinds.mean + estimate.weights @ kinds.factor

    def payload(self, coefficients: Float[Tensor, "r"]) -> Payload:
        """Decode."""
        latents = self.prior.mean + self.prior.picture(coefficients[None])
        return payload_from_cells(self.codec.decode(latents)[0], self.full_density, self.codec.zone)

    def start(
        self, views: Views, frames: Sequence[Frames], on_step: Callable[[], None] = lambda: None
    ) -> PosteriorEstimate:
        """The people nearest to the human in views with these frames; reports `start_steps` times."""
        every, steps = math.ceil(len(frames) / SEARCH_VIEWS), self.start_steps

        def refine(people: PosteriorEstimate, side: int, count: int) -> PosteriorEstimate:
            nonlocal steps
            for _ in range(count):
                people, steps = self.gauss_newton_step(people, targets_of(views, frames, side)[::every]), steps - 1
                on_step()
            return people

        def search(
            people: Sequence[PosteriorEstimate], kinds: Sequence[Sequence[Kind]], stage: SearchStage
        ) -> list[PosteriorEstimate]:
            targets = targets_of(views, frames, stage.side)[::every]
            found = [one for each, own in zip(people, kinds, strict=True) for one in self.within(each, own, targets)]
            chosen = best(found, stage.candidates)
            return [refine(self._mean_of(one.group, one.head), stage.side, stage.steps) for one in chosen]

        people = refine(self.everyone(), STARTING_SIDE, STARTING_STEPS)
        groups = [(group, None) for group in range(len(self.prior.log_weight))]
        outfits = best(search([people], [groups], OUTFITS), BEST_OUTFITS)
        heads = [[(int(one.group or 0), head) for head in self.prior.heads_of(int(one.group or 0))] for one in outfits]
        found = best(search(outfits, heads, HEADS), 1)[0]
        for _ in range(steps):  # of outfits with fewer hair styles than others
            on_step()
        return found

    def within(
        self, estimate: PosteriorEstimate, kinds: Sequence[Kind], targets: Sequence[PosedView]
    ) -> list[PosteriorEstimate]:
        """Evidence of kinds of the people, without their weights, in pictures that are linearised at these weights.

        Kinds are seen in the directions of the people: fast, and near enough to choose those worth a step of their own.
        """
        of, _ = self._kinds(estimate.group, estimate.head)
        precision, vector, misfit = self._information(estimate, targets)
        precision, vector, into = precision.double(), vector.double(), torch.linalg.pinv(of.factor)
        found = []
        for group, head in kinds:
            own = self.prior.gaussian_of(group, head)
            mean, factor = ((own.mean - of.mean) @ into).double(), (own.factor @ into).double()
            covariance, slope = factor.T @ factor, vector - precision @ mean
            spread = torch.eye(len(mean)) + covariance @ precision
            gain = slope @ torch.linalg.solve(spread, covariance @ slope) - torch.linalg.slogdet(spread).logabsdet
            evidence = float(gain / 2 + (vector + slope) @ mean / 2) - misfit
            found.append(PosteriorEstimate(group, head, mean.new_zeros(0), evidence))
        return found

    def everyone(self) -> PosteriorEstimate:
        """All people, at the mean human."""
        return self._mean_of(None, None)

    def _mean_of(self, group: int | None, head: int | None) -> PosteriorEstimate:
        kinds, _ = self._kinds(group, head)
        return PosteriorEstimate(group, head, torch.zeros(len(kinds.factor)), 0.0)

    def fit(
        self,
        views: Views,
        frames: Sequence[Frames],
        estimate: PosteriorEstimate,
        on_step: Callable[[], None] = lambda: None,
        generator: torch.Generator | None = None,
    ) -> Payload:
        """The human in views with these frames: STEPS steps from there, then voxels. Reports FIT_STEPS times.

        With a generator, coefficients are drawn from their distribution given the views, and the residual from that
        given the coefficients, instead of their means: what no view shows varies with it.
        """
        targets = targets_of(views, frames, COARSE_SIDE)
        for step in range(STEPS):
            estimate = self.gauss_newton_step(estimate, targets, generator if step == STEPS - 1 else None)
            on_step()
        targets = targets_of(views, frames, FINE_SIDE)
        settings = InverseSettings(pull=PULL / len(targets), smoothness=SMOOTHNESS / len(targets))
        person = self.coefficients(estimate)
        self._forget()
        residual = self.mean_residual(person) if generator is None else self.sample_residual(person, generator)
        start = self.decode(self.prior.join(person[None], residual[None])[0])
        if self.surfaces is not None:
            kind = self.prior.expected_kind(person[None])[0]
            start = with_colour_of(targets, start, self.surfaces.hair(kind))
        payload = fit_payload(start, targets, self.full_density, settings)
        on_step()
        return payload

    def mean_residual(self, coefficients: Float[Tensor, "r"]) -> Float[Tensor, "c h w"]:
        """Mean residual of humans with these coefficients: what the network makes of noise alone."""
        noise = gaussian_noise(self.prior.mean[None], torch.Generator().manual_seed(0))
        return self._denoise_residual(noise, self.denoiser.schedule.length - 1, coefficients)[0]

    def sample_residual(self, coefficients: Float[Tensor, "r"], generator: torch.Generator) -> Float[Tensor, "c h w"]:
        """Draw the residual of a human with these coefficients, by DDIM."""
        schedule, noise = self.denoiser.schedule, gaussian_noise(self.prior.mean[None], generator)

        def denoise(x: Tensor, t: int) -> Tensor:
            return self._denoise_residual(x, t, coefficients)

        *_, last = ddim(denoise, schedule, schedule.noise(self.chain[0]) * noise, self.chain, generator)
        return last.x0[0]

    def _denoise_residual(self, x: Float[Tensor, "1 c h w"], t: int, coefficients: Float[Tensor, "r"]) -> Tensor:
        """Clean estimate of a residual that holds noise of step t."""
        device = self.denoiser.component_std.device
        level, person = torch.tensor([t], device=device), coefficients[None].to(device)
        with torch.inference_mode():
            residual = self.denoiser.rest(self.prior.outside(x).to(device), person, level)
        return self.prior.outside(residual.cpu().clone())

    def gauss_newton_step(
        self, estimate: PosteriorEstimate, targets: Sequence[PosedView], generator: torch.Generator | None = None
    ) -> PosteriorEstimate:
        """Step from these weights to their posterior mean or, with a generator, to a draw."""
        precision, vector, misfit = self._information(estimate, targets)
        factor = torch.linalg.cholesky(precision.double() + torch.eye(len(vector)))
        mean = torch.cholesky_solve(vector.double()[:, None], factor)[:, 0]
        evidence = float(mean @ vector.double()) / 2 - float(factor.diagonal().log().sum()) - misfit
        if generator is not None:
            noise = torch.randn(len(mean), 1, generator=generator, dtype=mean.dtype)
            mean = mean + torch.linalg.solve_triangular(factor.mT, noise, upper=True)[:, 0]
        return PosteriorEstimate(estimate.group, estimate.head, mean.float(), evidence)

    def _information(
        self, estimate: PosteriorEstimate, targets: Sequence[PosedView]
    ) -> tuple[Float[Tensor, "n n"], Float[Tensor, "n"], float]:
        """Pictures, linearised at these weights: their log probability is vector w - w precision w / 2 - misfit."""
        prior, codec = self.prior, self.codec
        kinds, codes = self._kinds(estimate.group, estimate.head)
        weights = estimate.weights
        latents = prior.mean + prior.picture((kinds.mean + weights @ kinds.factor)[None])
        cells = codec.decode(latents)[0].requires_grad_()
        payload = payload_from_cells(cells, self.full_density, codec.zone)
        # Each colour and density depends on its own value of the cells, so the gradient of their sum has all
        # derivatives.
        (by_cell,) = torch.autograd.grad(payload.rgb.sum() + payload.density.sum(), cells)
        slope = by_cell[:, :VOXEL_VALUES].unflatten(1, (4, S**3)).mT.flatten(0, 1).numpy()
        payload, region = payload.map(Tensor.detach), codec.region.numpy()
        precision, vector = torch.zeros(len(weights), len(weights)), torch.zeros(len(weights))
        misfit = 0.0  # of weights of 0
        for target in targets:
            view = LinearisedView.of(target, payload, InverseSettings())
            seen = np.bincount(view.jacobian.ray, minlength=view.jacobian.rays) > 0
            by_code = apply_to_codes(view.jacobian, slope, self._voxel_basis, region, codes, view.alpha_free)
            matrix = torch.from_numpy(by_code[seen]).flatten(0, 1)
            pixel_weights = view.weight * np.float32(OBSERVATIONS / PIXEL_STD**2)
            weight = torch.from_numpy(pixel_weights[seen]).flatten()
            wanted = torch.from_numpy(view.residual[seen]).flatten() + matrix @ weights
            weighted = matrix.mT * weight
            precision += weighted @ matrix
            vector += weighted @ wanted
            misfit += float(weight.double() @ wanted.double().square()) / 2
            misfit += float((pixel_weights[~seen] * view.residual[~seen] ** 2).sum(dtype=np.float64)) / 2
        return precision, vector, misfit


def best(candidates: Sequence[PosteriorEstimate], count: int) -> list[PosteriorEstimate]:
    """The candidates that explain the pictures best."""
    return sorted(candidates, key=lambda one: one.evidence, reverse=True)[:count]


def with_colour_of(targets: Sequence[PosedView], human: Payload, part: Float[Tensor, "k 512"]) -> Payload:
    """The human with a part of it, given as each voxel's share, in the colour that the pictures show there."""
    share = part.view(-1, 1, S, S, S)
    marked, drawn, shown = dataclasses.replace(human, rgb=share.expand_as(human.rgb)), [], []
    for target in targets:
        amount, picture = (march(Primitives.place(target.frames, one), target.camera).rgb for one in (marked, human))
        sure = (amount[..., 0] > SURELY) & (target.rgba[..., 3] > SURELY)
        drawn.append(encode_srgb(picture[sure]))
        shown.append(encode_srgb(target.rgba[sure][:, :3]))
    before, after = torch.cat(drawn), torch.cat(shown)
    if len(before) < FEWEST_PIXELS:
        return human
    change = after.median(0).values / before.median(0).values.clamp_min(BLACK) - 1
    rgb = encode_srgb(human.rgb) * (1 + share * change.view(3, 1, 1, 1))
    return dataclasses.replace(human, rgb=decode_srgb(rgb.clamp(0, 1)))


def targets_of(views: Views, frames: Sequence[Frames], largest: int) -> list[PosedView]:
    """The views as linear pictures with sides of at most `largest` pixels, averaged over blocks."""
    targets = []
    for number, (rgba, boxes) in enumerate(zip(views.rgba.cpu(), frames, strict=True)):
        camera = views.camera.to("cpu").map(lambda values, number=number: values[number])
        picture = torch.cat([decode_srgb(rgba[..., :3].float() / 255), rgba[..., 3:].float() / 255], -1)
        block = math.ceil(max(camera.width, camera.height) / largest)
        height, width = camera.height // block, camera.width // block
        picture = picture[: height * block, : width * block].unflatten(1, (width, block)).unflatten(0, (height, block))
        intrinsics = torch.cat([camera.intrinsics[:2] / block, camera.intrinsics[2:]])
        camera = dataclasses.replace(camera, intrinsics=intrinsics, width=width, height=height)
        targets.append(PosedView(boxes, camera, picture.mean((1, 3))))
    return targets
