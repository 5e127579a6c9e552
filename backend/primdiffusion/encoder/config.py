"""Settings of the encoder: ours, the paper's, the released code's, and the ablations of the paper's Table 3."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from primdiffusion.formats.requests import Count
from primdiffusion.formats.schema import Checked, Length, Range, read
from primdiffusion.primitives.primitives import GRID, S

MOST_BLOCKS = 16
"""Consecutive blocks of attention; the paper has 2."""


@dataclasses.dataclass(frozen=True)
class EncoderConfig(Checked):
    """Architecture of the encoder (paper sec. 3.2; SPEC 2)."""

    appearance: Literal["voxels", "texels", "texture"] = "voxels"
    """Place where images are sampled: on the body surface at each texel (paper), at each voxel of the boxes, or as a
    texture of 512 x 512 texels, resized to 256 x 256 (SPEC 2)."""
    masks: Literal["whole", "eroded"] = "whole"
    """eroded: images and masks lose the pixels within one of the mask's outline, as in the released code's training."""
    unseen: Literal["filled", "black"] = "filled"
    """filled: points that no view sees are inpainted from their surroundings, and extra channels hold visibility and
    mask coverage; black: such points are black, and the network's input is colours only (SPEC 2)."""
    facing: int = 2
    """Views are weighted by the cosine to the surface normal to this power; 0: all visible views equally (paper)."""
    attention: Literal["cross", "concatenated", "none"] = "cross"
    """cross: appearance queries motion and back (paper); concatenated: self-attention over both (released); none."""
    delta_scale: Literal["varying", "shared"] = "varying"
    """Scale factors per box, or shared by all boxes of a human (the paper's ablation)."""
    frames: Literal["person", "template"] = "person"
    """The body that carries the boxes: the subject's, or the mean shape (the paper's ablation "w/o R, T")."""
    base: Literal["looked_up", "constant"] = "looked_up"
    """Values to which the networks' output is added: the one sampled at each voxel, or a constant (paper)."""
    detail: Literal["skips", "bottleneck"] = "skips"
    """skips: mapping networks also get the image encoder's finer levels; bottleneck: the 32 x 32 features (paper)."""
    compat: Literal["none", "released"] = "none"
    """released: layers and boxes of the authors' checkpoints: weights normalised over the whole tensor, residual blocks
    and order of branches of SPEC 2, boxes with B = T x N whose sizes are divided by the scale (SPEC 1.1, 1.8)."""
    stem: tuple[int, int, int] = (24, 48, 64)
    """Channels of the image encoder at 128, 64 and 32 squared."""
    grid: Annotated[tuple[int, ...], Length(1, GRID.bit_length())] = (64, 96, 96, 96)
    """Channels of its U-Net at 32, 16, 8, ... squared, at most down to one texel."""
    grid_entry: Literal["residual", "halving"] = "residual"
    """residual: starts with a residual block at 32 squared; halving: starts with the downsampling to 16 squared, and
    concatenates the input at the end (SPEC 2)."""
    grid_outputs: int = 0
    """Output channels of the U-Net; 0: as many as at 32 squared."""
    grid_gain: float = 1.0
    """Factor on the U-Net's output."""
    motion: int = 32
    """Channels of the motion branch."""
    attention_width: int = 128
    """Channels over all heads."""
    attention_heads: Count = 4
    """Heads."""
    attention_blocks: Annotated[int, Range(1, MOST_BLOCKS)] = 1
    """Consecutive blocks."""
    fused: int = 64
    """Input channels of the mapping networks."""
    colour: tuple[int, int] = (48, 24)
    """Channels of the colour network at 64 and 128 squared."""
    density: tuple[int, int] = (32, 16)
    """Channels of the density network at 64 and 128 squared."""
    finest: int = 16
    """Channels of both at 256 squared, before concatenation with the sampled input."""
    scale: tuple[int, ...] = (64, 64)
    """Channels of the delta-scale network."""
    scale_outputs: Annotated[int, Range(3)] = 3
    """Output channels; only the last three are used: the released code has six unused ones before (SPEC 1.7)."""
    extent: tuple[float, float, float] = (0.85, 0.85, 0.45)
    """Initial delta scales along T, B, N: the anchors' boxes are large enough for loose clothing, and most of a human
    is sharper with smaller ones."""
    thickness: Literal["hull", "constant"] = "hull"
    """hull: a box whose outer voxels the masks cover (hair, a skirt) starts thicker than `extent`, up to the anchor's;
    constant: all start with `extent`."""
    scale_gain: float = 0.02
    """delta scale = extent exp(gain x)."""
    colour_gain: float = 0.06
    """Colours = base + gain x, clamped to 0 ... 1. Small, so that colours do not compensate for wrong densities."""
    density_gain: float = 0.25
    """Same as `colour_gain`, for relative densities."""
    full_density: float = 100.0
    """1/m: the density that corresponds to a relative density of 1."""

    @property
    def channels(self) -> int:
        """Input channels of the image encoder at 256 x 256."""
        colours = 3 * self.layers
        if self.unseen == "black":
            return colours
        return colours + self.layers * (2 if self.appearance == "voxels" else 1)

    @property
    def appearance_channels(self) -> int:
        """Output channels of the image encoder's U-Net."""
        return self.grid_outputs or self.grid[0]

    @property
    def layers(self) -> int:
        """Sampled points per texel."""
        return S if self.appearance == "voxels" else 1

    def __post_init__(self) -> None:
        """Raise ValueError for invalid settings."""
        super().__post_init__()
        if self.attention_width % self.attention_heads:
            raise ValueError(
                f"attention_width {self.attention_width} is not a multiple of attention_heads {self.attention_heads}"
            )
        if self.compat == "released" and (self.detail, self.grid_entry) != ("bottleneck", "halving"):
            raise ValueError(
                f"compat 'released' has no layers for detail {self.detail!r} with grid_entry {self.grid_entry!r}: "
                "choose 'bottleneck' and 'halving'"
            )


DEFAULT = EncoderConfig()
PAPER = EncoderConfig(
    appearance="texels",
    unseen="black",
    facing=0,
    base="constant",
    detail="bottleneck",
    stem=(4, 8, 16),
    grid=(64, 64, 64, 64, 64, 64),
    grid_entry="halving",
    grid_gain=0.1,
    attention_width=256,
    attention_blocks=2,
    colour=(32, 16),
    density=(32, 16),
    scale=(64, 128, 64, 64),
    extent=(1.0, 1.0, 1.0),
    thickness="constant",
    scale_gain=0.01,
    colour_gain=25 / 255,
    density_gain=25 / 255,
    full_density=25.5,
)
"""The architecture of the paper, with most sizes of SPEC 2 where the paper gives none."""
RELEASED = dataclasses.replace(
    PAPER,
    appearance="texture",
    masks="eroded",
    attention="concatenated",
    compat="released",
    grid=(8, 8, 16, 32, 64, 128),
    grid_outputs=64,
    scale_outputs=9,
)
"""The authors' stage 1 (SPEC 2)."""
Preset = Literal["default", "paper", "released"]
PRESETS: dict[Preset, EncoderConfig] = {"default": DEFAULT, "paper": PAPER, "released": RELEASED}
Ablation = Literal["shared_scale", "template_rt", "no_attention"]


def encoder_config(preset: Preset, ablation: Ablation | None = None) -> EncoderConfig:
    """Return the settings of a preset, with one of the ablations of the paper's Table 3."""
    config = PRESETS[preset]
    match ablation:
        case "shared_scale" if config.thickness == "hull":  # boxes of one size cannot follow the hull: thicker ones
            thicker = (*config.extent[:2], 0.6)
            return dataclasses.replace(config, delta_scale="shared", thickness="constant", extent=thicker)
        case "shared_scale":
            return dataclasses.replace(config, delta_scale="shared")
        case "template_rt":
            return dataclasses.replace(config, frames="template")
        case "no_attention":
            return dataclasses.replace(config, attention="none")
    return config


def config_from_json(tree: Mapping[str, Any]) -> EncoderConfig:
    """Restore a configuration from the JSON form of `dataclasses.asdict`.

    Raises:
        ValueError: settings are unknown to this version, missing or invalid.
    """
    names = {field.name for field in dataclasses.fields(EncoderConfig)}
    if set(tree) != names:
        differing = ", ".join(sorted(set(tree) ^ names))
        raise ValueError(f"the encoder's configuration differs in {differing}: use the release that trained it")
    return read(EncoderConfig, tree)
