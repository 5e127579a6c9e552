"""Latents that a detail decoder is trained on: of coarse payloads and of finer ones of the same humans."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion import tensor_file
from primdiffusion.diffusion.codec import LinearCodec, cells_from_voxels
from primdiffusion.diffusion.model import DiffusionModel, seeded
from primdiffusion.formats.whole_files import write_atomically
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.training.config import CodecConfig
from primdiffusion.training.latents import fit_codec_to
from primdiffusion.training.stored_people import PersonDataset

PREPARED = "prepared.safetensors"
NOISE_LEVELS = (60, 150, 300)
"""Steps t of 1000 whose one-step guesses the decoder is trained on, besides clean latents (0)."""
CHUNK = 16
"""Samples that are converted from half precision at once."""
RIDGE = 1e-3
"""Of least squares, relative to the mean variance."""


@dataclasses.dataclass(frozen=True)
class DetailSet(TensorRecord):
    """Latents of N samples, float16."""

    coarse: Float[Tensor, "n levels c 32 32"]
    """Clean, and the model's guesses at NOISE_LEVELS."""
    fine: Float[Tensor, "n d 32 32"]
    geometry: Int[Tensor, "n"]
    """Geometry of each sample; ascending."""


@dataclasses.dataclass(frozen=True)
class PreparedDetail(TensorRecord):
    """What a run computes before training."""

    train: DetailSet
    held: DetailSet
    codec: LinearCodec
    """The finer codec."""
    forward: Float[Tensor, "d c"]
    """From coarse latents to fine ones, least squares."""
    back: Float[Tensor, "c c"]
    """From the coarse codec's latents of decoded fine payloads to latents of coarse ones, least squares."""
    latent_std: Float[Tensor, "c"]
    rest_std: Float[Tensor, "d"]
    """Of what `forward` leaves."""


def prepare(
    path: Path,
    base: DiffusionModel,
    coarse_codec: LinearCodec,
    fine: PersonDataset,
    coarse: PersonDataset,
    split: tuple[Sequence[int], Sequence[int]],
    config: CodecConfig,
    seed: int,
) -> PreparedDetail:
    """Return latents of both sets and the linear maps between them; saved at `path`, and loaded if they are there.

    `split`: humans to train on, and those held out. `config`: of the finer codec.

    Raises ValueError for a person's file, or prepared ones, that are damaged; OSError.
    """
    train, held = split
    if path.exists():
        return _load_prepared(path)
    codec = fit_codec_to(fine, train, config, torch.Generator().manual_seed(seed))
    codec, sets, again = codec.to(base.device), [], []
    for indices in (train, held):
        clean, guessed, wanted, geometry = [], [], [], []
        for place, index in enumerate(indices):
            one, other = coarse.person(index), fine.person(index)
            latents = coarse_codec.encode(cells_from_voxels(one.voxels, one.delta_scale).to(base.device))
            clean.append(latents)
            guessed.append(_with_guesses(base, latents, seed + index).half().cpu())
            wanted.append(codec.encode(cells_from_voxels(other.voxels, other.delta_scale).to(base.device)).half().cpu())
            geometry.append(torch.full((len(latents),), place))
            if indices is train:
                again.append(coarse_codec.encode(codec.decode(wanted[-1].float().to(base.device))).half().cpu())
        sets.append(DetailSet(torch.cat(guessed), torch.cat(wanted), torch.cat(geometry)))
    known = sets[0]
    forward = _least_squares(_chunks(known))
    back = _least_squares(
        zip(
            (chunk.float() for chunk in torch.cat(again).split(CHUNK)),
            (coarse for coarse, _ in _chunks(known)),
            strict=True,
        )
    )
    rest = [_moments(fine - torch.einsum("dc,nchw->ndhw", forward, coarse)) for coarse, fine in _chunks(known)]
    scale = [_moments(coarse) for coarse, _ in _chunks(known)]
    prepared = PreparedDetail(
        known, sets[1], codec.to("cpu"), forward, back,
        *(torch.stack(each).mean(0).sqrt().clamp_min(1e-6) for each in (scale, rest)),
    )  # fmt: skip
    _save_prepared(path, prepared)
    return prepared


def _with_guesses(
    base: DiffusionModel, latents: Float[Tensor, "n c 32 32"], seed: int
) -> Float[Tensor, "n levels c 32 32"]:
    """Clean latents, and the model's guesses of them from each of NOISE_LEVELS."""
    generator, versions = seeded(seed), [latents]
    for level in NOISE_LEVELS:
        noise = torch.randn(latents.shape, generator=generator).to(latents.device)
        noisy = base.schedule.q_sample(latents, torch.full((len(latents),), level, device=latents.device), noise)
        versions.append(base.denoise(noisy, level))
    return torch.stack(versions, dim=1)


def _chunks(known: DetailSet) -> Iterator[tuple[Tensor, Tensor]]:
    """Clean coarse latents and fine ones, in float32, some samples at a time."""
    for coarse, fine in zip(known.coarse[:, 0].split(CHUNK), known.fine.split(CHUNK), strict=True):
        yield coarse.float(), fine.float()


def _least_squares(pairs: Iterable[tuple[Tensor, Tensor]]) -> Float[Tensor, "d c"]:
    """The matrix that maps the cells [n, c, 32, 32] of the first of each pair to those [n, d, 32, 32] of the second."""
    square, product = torch.zeros(()), torch.zeros(())
    for one, other in pairs:
        x, y = one.movedim(1, -1).flatten(0, -2), other.movedim(1, -1).flatten(0, -2)
        square, product = square + (x.T @ x).double(), product + (x.T @ y).double()
    ridge = RIDGE * square.diagonal().mean() * torch.eye(len(square), dtype=square.dtype)
    return torch.linalg.solve(square + ridge, product).T.float().contiguous()


def _moments(latents: Float[Tensor, "n c 32 32"]) -> Float[Tensor, "c"]:
    """Mean square of each channel."""
    return latents.square().mean((0, 2, 3))


def _save_prepared(path: Path, prepared: PreparedDetail) -> None:
    tensors = {}
    for field in dataclasses.fields(prepared):
        value = getattr(prepared, field.name)
        parts = {"": value} if isinstance(value, Tensor) else vars(value)
        tensors |= {f"{field.name}.{key}": part.contiguous() for key, part in parts.items()}
    write_atomically(path, tensor_file.save(tensors))


def _load_prepared(path: Path) -> PreparedDetail:
    try:
        parts: dict[str, dict[str, Tensor]] = {}
        for key, value in tensor_file.read(path)[0].items():
            name, _, part = key.partition(".")
            parts.setdefault(name, {})[part] = value
        return PreparedDetail(
            DetailSet(**parts["train"]), DetailSet(**parts["held"]), LinearCodec(**parts["codec"]),
            *(parts[name][""] for name in ("forward", "back", "latent_std", "rest_std")),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged ({error!s:.100}): remove it to compute it again") from error
