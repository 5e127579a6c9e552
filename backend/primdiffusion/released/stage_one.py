"""Validate the 165 tensors of stage 1 (`bodydecoder.*`); none is imported.

SPEC 6 gives the groups and their numbers of tensors, SPEC 2 the layers. That is enough to validate a file but not to
run it: neither states over which axes weights are normalised, and shapes do not determine it.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Mapping, Sequence

from torch import Tensor

from primdiffusion.released.reading import ReleasedFileError, TensorEntry

PREFIX = "bodydecoder."
TENSORS = {
    "lbs_fn": 7,
    "geo_fn": 7,
    "local_pose_conv_block": 9,
    "joint_conv_block": 9,
    "embs_encoder": 42,
    "decoder_motion": 15,
    "decoder_rgb": 9,
    "decoder_alpha": 9,
    "decoder_geom": 12,
    "transformer": 46,
}
"""Number of tensors in each group (SPEC 6)."""
NOT_USED = {
    "lbs_fn": "the licensed SMPL model: read from your files instead",
    "geo_fn": "the licensed SMPL model's UV: read from your files instead",
    "decoder_geom": "unused by the released code",
}
NOT_CARRIED_OVER = "has the layers of the encoder 'released'; stage 1 is not imported"


@dataclasses.dataclass(frozen=True)
class DecoderLayer:
    """A weight-normalised convolution, mostly with a bias per position: three tensors (SPEC 2)."""

    weight: tuple[int | None, ...]
    """[out, in, k, k], or [in, out, k, k] if transposed; None where SPEC 2 does not specify it."""
    bias: tuple[int | None, ...]
    """[out, side, side], or [out] without positions."""


def _same(outputs: int, inputs: int, kernel: int) -> DecoderLayer:
    return DecoderLayer((outputs, inputs, kernel, kernel), (outputs, 32, 32))


def _residual(inputs: int, outputs: int, kernel: int) -> list[DecoderLayer]:
    """A residual block: two convolutions, and a 1 x 1 one with an ordinary bias beside them."""
    beside = DecoderLayer((outputs, inputs, 1, 1), (outputs,))
    return [_same(inputs, inputs, kernel), _same(outputs, inputs, kernel), beside]


def _up(inputs: int, outputs: int, side: int) -> DecoderLayer:
    return DecoderLayer((inputs, outputs, 4, 4), (outputs, side, side))


def _up_thrice(outputs: int) -> list[DecoderLayer]:
    return [_up(64, 32, 64), _up(32, 16, 128), _up(16, outputs, 256)]


def _of_u_net(side: int) -> DecoderLayer:
    return DecoderLayer((None,) * 4, (None, side, side))


LAYERS: dict[str, list[DecoderLayer]] = {
    "local_pose_conv_block": _residual(69, 32, 1),
    "joint_conv_block": _residual(96, 64, 3),
    "embs_encoder": [
        *(DecoderLayer((o, i, 4, 4), (o, side, side)) for i, o, side in ((3, 4, 128), (4, 8, 64), (8, 16, 32))),
        DecoderLayer((64, None, 1, 1), (64, 32, 32)),
        *(_of_u_net(side) for side in (16, 8, 4, 2, 1, 2, 4, 8, 16, 32)),
    ],
    "decoder_motion": [_same(o, i, 3) for i, o in ((64, 64), (64, 128), (128, 64), (64, 64), (64, 9))],
    "decoder_rgb": _up_thrice(3 * 8),
    "decoder_alpha": _up_thrice(8),
}
"""Layers of SPEC 2, most specific first; the small U-Net goes from 32 x 32 to 1 x 1 and back, with unknown channels."""
ATTENTION: list[tuple[int, ...]] = [(256, 96), (96, 256), *[(2048, 256), (256, 1024)] * 2]
"""Matrices of the transformer in SPEC 2: to 256 channels, back to 96, and two gated feed-forwards."""


def account_stage_one(tensors: Mapping[str, Tensor], prefix: str = PREFIX) -> list[TensorEntry]:
    """Validate the tensors (names without `prefix`, which error messages include).

    Groups that are not used may be of any shape, incomplete or missing. Raises ReleasedFileError, naming a tensor that
    is unknown or has a wrong shape, or an incomplete group.
    """
    groups: dict[str, dict[str, Tensor]] = {group: {} for group in TENSORS}
    for name, value in tensors.items():
        group = name.partition(".")[0]
        if group not in groups:
            raise ReleasedFileError(
                f"unknown tensor '{prefix}{name}' {tuple(value.shape)}: give the authors' primdiffusion.pt"
            )
        groups[group][f"{prefix}{name}"] = value
    for group, found in groups.items():
        if group in NOT_USED:
            continue
        if group in LAYERS:
            _check_layers(group, found)
        if len(found) != TENSORS[group]:
            names = ", ".join(found) or "none"
            raise ReleasedFileError(
                f"'{prefix}{group}' has {len(found)} tensors, not {TENSORS[group]}: {names}; download the checkpoint "
                "again"
            )
    _check_attention(groups["transformer"])
    return [
        TensorEntry(
            f"{prefix}{name}",
            group := name.partition(".")[0],
            tuple(value.shape),
            "dropped" if group in NOT_USED else "checked",
            NOT_USED.get(group, NOT_CARRIED_OVER),
        )
        for name, value in tensors.items()
    ]


def _check_layers(group: str, found: Mapping[str, Tensor]) -> None:
    modules: dict[str, list[str]] = collections.defaultdict(list)
    for key in found:
        modules[key.rpartition(".")[0]].append(key)
    left = list(LAYERS[group])
    for module, keys in modules.items():
        weight, bias = _weight_and_bias(module, {key: found[key] for key in keys})
        shapes = tuple(found[weight].shape), tuple(found[bias].shape)
        fitting = [layer for layer in left if _fits(shapes[0], layer.weight) and _fits(shapes[1], layer.bias)]
        if not fitting:
            rest = "; ".join(f"{_written(layer.weight)} with {_written(layer.bias)}" for layer in left) or "none"
            raise ReleasedFileError(
                f"{weight!r} {shapes[0]} with {bias!r} {shapes[1]} matches no layer of {group}; unmatched layers: "
                f"{rest}"
            )
        left.remove(fitting[0])


def _weight_and_bias(module: str, found: Mapping[str, Tensor]) -> tuple[str, str]:
    """Names of the weight and bias among a convolution's three tensors; the third is the per-channel gain."""
    weights = [key for key, value in found.items() if value.ndim == 4 and value.numel() > max(value.shape)]
    biases = [key for key, value in found.items() if value.ndim == 3]
    if not biases:  # without positions it has the gain's shape, and only its name tells it
        biases = [key for key, value in found.items() if value.ndim == 1 and key.rpartition(".")[2] == "bias"]
    gains = [key for key in found if key not in weights + biases]
    if not len(weights) == len(biases) == len(gains) == 1:
        given = ", ".join(f"{key!r} {tuple(value.shape)}" for key, value in found.items())
        raise ReleasedFileError(f"{module!r} is not a convolution with weight, gain and bias: it has {given}")
    channels = found[biases[0]].shape[0]
    if found[gains[0]].numel() != channels:
        raise ReleasedFileError(
            f"{gains[0]!r} has shape {tuple(found[gains[0]].shape)}, not one value per channel of {biases[0]!r} "
            f"{tuple(found[biases[0]].shape)}"
        )
    return weights[0], biases[0]


def _check_attention(found: Mapping[str, Tensor]) -> None:
    matrices = [tuple(side for side in value.shape if side != 1) for value in found.values()]
    for wanted in ATTENTION:
        if matrices.count(wanted) < ATTENTION.count(wanted):
            given = ", ".join(f"{key!r} {tuple(value.shape)}" for key, value in found.items() if value.ndim > 1)
            raise ReleasedFileError(f"the transformer lacks a matrix of shape {wanted}; it has {given}")


def _fits(shape: Sequence[int], wanted: Sequence[int | None]) -> bool:
    return len(shape) == len(wanted) and all(w in (None, s) for s, w in zip(shape, wanted, strict=True))


def _written(shape: Sequence[int | None]) -> str:
    return " x ".join("?" if side is None else str(side) for side in shape)
