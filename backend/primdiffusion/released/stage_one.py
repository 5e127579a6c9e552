"""Validate the 165 tensors of stage 1 (`bodydecoder.*`) and convert them to the encoder "released" (SPEC 2, 6).

SPEC 6 gives the groups and their numbers of tensors, SPEC 2 the layers, but names within the groups are only partly
known. A convolution is identified by its group and the shapes of its weight and bias; of two with the same shapes, the
one whose name is first in natural order is the first in the network. The transformer's names are those of the
denoiser's (latent diffusion).
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from primdiffusion.encoder.config import RELEASED
from primdiffusion.encoder.network import Encoder
from primdiffusion.released.reading import TensorEntry

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
IMPORTED = "as the encoder 'released'"


class ConvolutionNames(NamedTuple):
    """Names of the three tensors of a weight-normalised convolution."""

    weight: str
    """[out, in, k, k], or [in, out, k, k] if transposed: the direction v."""
    gain: str
    """One value per output channel."""
    bias: str
    """[out, side, side], or [out] without positions."""


@dataclasses.dataclass(frozen=True)
class DecoderLayer:
    """A convolution of the encoder "released"."""

    name: str
    """Module in `Encoder`."""
    weight: tuple[int, ...]
    bias: tuple[int, ...]


def _same(name: str, outputs: int, inputs: int, kernel: int) -> DecoderLayer:
    return DecoderLayer(name, (outputs, inputs, kernel, kernel), (outputs, 32, 32))


def _residual(name: str, inputs: int, outputs: int, kernel: int) -> list[DecoderLayer]:
    """A residual block: two convolutions, and a 1 x 1 one with an ordinary bias beside them."""
    shortcut = DecoderLayer(f"{name}.shortcut", (outputs, inputs, 1, 1), (outputs,))
    return [_same(f"{name}.first", inputs, inputs, kernel), _same(f"{name}.second", outputs, inputs, kernel), shortcut]


def _down(name: str, inputs: int, outputs: int, side: int) -> DecoderLayer:
    return DecoderLayer(name, (outputs, inputs, 4, 4), (outputs, side, side))


def _up(name: str, inputs: int, outputs: int, side: int) -> DecoderLayer:
    return DecoderLayer(name, (inputs, outputs, 4, 4), (outputs, side, side))


def _up_thrice(name: str, outputs: int) -> list[DecoderLayer]:
    steps = ((64, 32, 64), (32, 16, 128), (16, outputs, 256))
    return [_up(f"{name}.up.{n}", i, o, side) for n, (i, o, side) in enumerate(steps)]


_STEM = ((3, 4, 128), (4, 8, 64), (8, 16, 32))
_INWARD = ((16, 8, 16), (8, 16, 8), (16, 32, 4), (32, 64, 2), (64, 128, 1))
_OUTWARD = ((128, 64, 2), (64, 32, 4), (32, 16, 8), (16, 8, 16), (8, 8, 32))
_SCALE = ((64, 64), (64, 128), (128, 64), (64, 64))
LAYERS: dict[str, list[DecoderLayer]] = {
    "local_pose_conv_block": _residual("motion", 69, 32, 1),
    "joint_conv_block": _residual("fuse", 96, 64, 3),
    "embs_encoder": [
        *(_down(f"stem.{n}", *sizes) for n, sizes in enumerate(_STEM)),
        *(_down(f"appearance.down.{n}", *sizes) for n, sizes in enumerate(_INWARD)),
        *(_up(f"appearance.up.{n}", *sizes) for n, sizes in enumerate(_OUTWARD)),
        _same("appearance.leave", 64, 24, 1),
    ],
    "decoder_motion": [
        *(_same(f"scale.{n}", o, i, 3) for n, (i, o) in enumerate(_SCALE)),
        _same("scale_out", 9, 64, 3),
    ],
    "decoder_rgb": _up_thrice("colour", 3 * 8),
    "decoder_alpha": _up_thrice("density", 8),
}
"""Layers of SPEC 2 in the order of the network."""


def _attention_names() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Each parameter of the encoder's attention with the names in the file whose rows it consists of."""
    for ours, theirs in (("norm", "norm"), ("enter", "proj_in"), ("leave", "proj_out")):
        yield from ((f"{ours}.{part}", (f"{theirs}.{part}",)) for part in ("weight", "bias"))
    for number in range(RELEASED.attention_blocks):
        block = f"transformer_blocks.{number}"
        for step in range(2):
            ours, theirs = f"attentions.{2 * number + step}", f"{block}.attn{step + 1}"
            yield f"{ours}.query.weight", (f"{theirs}.to_q.weight",)
            yield f"{ours}.key_value.weight", (f"{theirs}.to_k.weight", f"{theirs}.to_v.weight")
            yield from ((f"{ours}.out.{part}", (f"{theirs}.to_out.0.{part}",)) for part in ("weight", "bias"))
        for part in ("weight", "bias"):
            yield f"forwards.{number}.enter.{part}", (f"{block}.ff.net.0.proj.{part}",)
            yield f"forwards.{number}.leave.{part}", (f"{block}.ff.net.2.{part}",)
            yield from ((f"norms.{3 * number + n}.{part}", (f"{block}.norm{n + 1}.{part}",)) for n in range(3))


ATTENTION = dict(_attention_names())
"""Names in the group "transformer" of the parameters of the encoder's `attention`."""


@functools.lru_cache(maxsize=1)
def _shapes() -> dict[str, tuple[int, ...]]:
    """Shapes of the encoder's parameters by name."""
    with torch.device("meta"):
        return {name: tuple(value.shape) for name, value in Encoder(RELEASED).state_dict().items()}


def account_stage_one(tensors: Mapping[str, Tensor], prefix: str = PREFIX) -> list[TensorEntry]:
    """Validate the tensors (names without `prefix`, which error messages include).

    Groups that are not used may be of any shape, incomplete or missing. Raises ValueError, naming a tensor that
    is unknown, of a wrong shape or not finite floating point, an incomplete group, or layers that cannot be told apart.
    """
    groups = _grouped(tensors, prefix)
    for group, found in groups.items():
        if group in NOT_USED:
            continue
        if group in LAYERS:
            _matched(group, found)
        if len(found) != TENSORS[group]:
            names = ", ".join(found) or "none"
            raise ValueError(
                f"'{prefix}{group}' has {len(found)} tensors, not {TENSORS[group]}: {names:.120}; download the "
                "checkpoint again"
            )
    _check_attention(groups["transformer"], prefix)
    for group, found in groups.items():
        for key, value in found.items():
            if group not in NOT_USED and not (value.is_floating_point() and torch.isfinite(value).all()):
                raise ValueError(
                    f"{key!r} has NaN or infinite values or is not floating point: download the checkpoint again"
                )
    return [
        TensorEntry(
            f"{prefix}{name}",
            group := name.partition(".")[0],
            tuple(value.shape),
            "dropped" if group in NOT_USED else "imported",
            NOT_USED.get(group, IMPORTED),
        )
        for name, value in tensors.items()
    ]


def encoder_tensors(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parameters (float32) of the encoder "released" by name, from tensors that `account_stage_one` has validated.

    Raises ValueError for a convolution whose weights are all zero, which has no direction.
    """
    groups, shapes, found = _grouped(tensors, ""), _shapes(), {}
    for group in LAYERS:
        for name, keys in _matched(group, groups[group]).items():
            weight, gain, bias = (tensors[key].float() for key in keys)
            if not weight.any():
                raise ValueError(f"{keys.weight!r} is all zero: download the checkpoint again")
            norm = f"{name}.convolution.parametrizations.weight"
            found[f"{norm}.original0"] = gain.reshape(shapes[f"{norm}.original0"])
            found[f"{norm}.original1"] = weight.contiguous()
            found[f"{name}.bias"] = bias.reshape(shapes[f"{name}.bias"])
    for name, parts in ATTENTION.items():
        value = torch.cat([tensors[f"transformer.{part}"].float() for part in parts])
        found[f"attention.{name}"] = value.reshape(shapes[f"attention.{name}"])
    return found


def _grouped(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, dict[str, Tensor]]:
    """The tensors of each group by their names with `prefix`."""
    groups: dict[str, dict[str, Tensor]] = {group: {} for group in TENSORS}
    for name, value in tensors.items():
        group = name.partition(".")[0]
        if group not in groups:
            raise ValueError(
                f"unknown tensor '{prefix}{name}' {tuple(value.shape)}: give the authors' primdiffusion.pt"
            )
        groups[group][f"{prefix}{name}"] = value
    return groups


def _matched(group: str, found: Mapping[str, Tensor]) -> dict[str, ConvolutionNames]:
    """The convolution in the file of each layer of a group, by the layer's module in `Encoder`."""
    modules: dict[str, dict[str, Tensor]] = collections.defaultdict(dict)
    for key, value in found.items():
        modules[key.rpartition(".")[0]][key] = value
    left, matched = list(LAYERS[group]), {}
    by_shapes: dict[tuple[tuple[int, ...], ...], str] = {}
    for module in sorted(modules, key=_natural):
        keys = _convolution(module, modules[module])
        shapes = tuple(found[keys.weight].shape), tuple(found[keys.bias].shape)
        fitting = [layer for layer in left if shapes == (layer.weight, layer.bias)]
        if not fitting:
            rest = "; ".join(f"{_written(layer.weight)} with {_written(layer.bias)}" for layer in left) or "none"
            raise ValueError(
                f"{keys.weight!r} {shapes[0]} with {keys.bias!r} {shapes[1]} matches no layer of {group}; unmatched "
                f"layers: {rest:.120}"
            )
        before = by_shapes.setdefault(shapes, module)
        if before != module and _NUMBER.sub("", before) != _NUMBER.sub("", module):
            raise ValueError(
                f"{before!r} and {module!r} have the same shapes and no numbers that tell which comes first: the "
                "checkpoint is of another version of the released code"
            )
        matched[fitting[0].name] = keys
        left.remove(fitting[0])
    return matched


_NUMBER = re.compile(r"\d+")


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key in which numbers within names count as numbers."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _convolution(module: str, found: Mapping[str, Tensor]) -> ConvolutionNames:
    """Tell the three tensors of a convolution apart."""
    weights = [key for key, value in found.items() if value.ndim == 4 and value.numel() > max(value.shape)]
    biases = [key for key, value in found.items() if value.ndim == 3]
    if not biases:  # without positions it has the gain's shape, and only its name tells it
        biases = [key for key, value in found.items() if value.ndim == 1 and key.rpartition(".")[2] == "bias"]
    gains = [key for key in found if key not in weights + biases]
    if not len(weights) == len(biases) == len(gains) == 1:
        given = ", ".join(f"{key!r} {tuple(value.shape)}" for key, value in found.items())
        raise ValueError(f"{module!r} is not a convolution with weight, gain and bias: it has {given:.190}")
    channels = found[biases[0]].shape[0]
    if found[gains[0]].numel() != channels:
        raise ValueError(
            f"{gains[0]!r} has shape {tuple(found[gains[0]].shape)}, not one value per channel of {biases[0]!r} "
            f"{tuple(found[biases[0]].shape)}"
        )
    return ConvolutionNames(weights[0], gains[0], biases[0])


def _check_attention(found: Mapping[str, Tensor], prefix: str) -> None:
    for ours, parts in ATTENTION.items():
        rows, *columns = (side for side in _shapes()[f"attention.{ours}"] if side != 1)
        expected = [rows // len(parts), *columns]
        for part in parts:
            key = f"{prefix}transformer.{part}"
            if key not in found:
                expected = {f"{prefix}transformer.{part}" for parts in ATTENTION.values() for part in parts}
                unknown = ", ".join(sorted(found.keys() - expected)) or "none"
                raise ValueError(f"{key!r} is missing; the transformer has unknown tensors instead: {unknown:.120}")
            if [side for side in found[key].shape if side != 1] != expected:
                raise ValueError(
                    f"{key!r} has shape {tuple(found[key].shape)}, not {tuple(expected)}: the checkpoint is of another "
                    "version of the released code, or damaged"
                )


def _written(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))
