"""Values and defaults of requests: on the command line, in JSON-RPC and in the extension's panels."""

from __future__ import annotations

from typing import Literal, get_args

Sampler = Literal["ddim", "dpmpp_2m", "ddpm"]
SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)
"""The first is the default."""
Transfer = Literal["texture", "garment"]
"""What is copied from another human: colours, or shape too."""
TRANSFERS: tuple[Transfer, ...] = get_args(Transfer)
"""The first is the default."""
Masking = Literal["repaint", "released"]
"""How inpainting conditions on the part that stays: noised to each step's own level and resampled, or as released."""
MASKINGS: tuple[Masking, ...] = get_args(Masking)
"""The first is the default."""
View = Literal["colour", "depth", "alpha", "boxes"]
"""Colours, depth in false colours, alpha in grey, or the primitives as boxes."""
VIEWS: tuple[View, ...] = get_args(View)
"""The first is the default."""
WHOLE_PARTS = (
    "face", "hair", "neck", "torso", "upper_arms", "forearms", "hands", "thighs", "shins", "feet", "hips",
    "head", "arms", "legs", "top", "bottom", "shoes", "clothes", "skin",
)  # fmt: skip
SIDED_PARTS = (
    "left_upper_arm", "right_upper_arm", "left_forearm", "right_forearm", "left_hand", "right_hand",
    "left_thigh", "right_thigh", "left_shin", "right_shin", "left_foot", "right_foot",
)  # fmt: skip
"""Left and right as seen by the human."""
PARTS = (*WHOLE_PARTS, *SIDED_PARTS)
"""Body parts that regions consist of."""

STEPS = 30
"""Sampler steps."""
GUIDANCE = 1.5
"""Weight of classifier-free guidance; 1 is plain conditioning, more costs variety."""
AMOUNT = 0.5
"""Strength of a variation: 0 changes nothing, 1 leaves hardly anything in common."""
FRACTION = 0.5
"""Position between two humans."""
Making = Literal["fitted", "from_mesh"]
"""How payloads are made: fitted to renders of the mesh, or with the colours of the nearest surface point."""
PASSES = ("img", "mask", "depth", "normal", "part")
"""Images of a captured view."""
LAYOUTS = ("nerf", "opencv", "colmap")
"""Camera files of other projects beside captures; the released code's files are always written."""
CAPTURE_VIEWS = 8
"""Cameras whose images the encoder gets."""
PICTURE_SIZE = 512
"""Width and height of previews, pixels."""
VARIATION_SIZE = 256
"""Width and height of the previews of variations, pixels."""
RAY_STEP = 0.004
"""Metres between samples of a ray."""
DENSITY_GAIN = 1.6
"""Factor on density for renderers with exponential absorption."""
VOXEL = 0.006
"""Voxel size of merged grids and of the grid for proxies, metres. Half of it resolves more of the primitives' own
voxels (2 to 14 mm) at eight times the memory."""
TRIANGLES = 20_000
"""Limit for a proxy."""
TEXTURE_SIZE = 1024
"""Width and height of a proxy's texture, pixels. Texels of 2 mm resolve the primitives' voxels: twice as many, enlarged
from these, differ by 0.5 of 255 levels (RMS)."""
GAUSSIANS = 400_000
"""Limit for an export."""


def check_unit_interval(name: str, value: float) -> None:
    """Raise ValueError unless `value` is in [0, 1]."""
    if not 0 <= value <= 1:
        raise ValueError(f"{name} is {value}: choose a number from 0 to 1")


LARGEST_SEED = 2**63 - 1


def check_seed(seed: int) -> None:
    """Raise ValueError outside 0 ... 2^63-1."""
    if not 0 <= seed <= LARGEST_SEED:
        raise ValueError(f"seed {seed} is outside 0 ... 2^63-1")


FINEST_STEP = 1e-4
"""Metres; a finer step takes hours without visible gain."""
COARSEST_STEP = 1.0


def check_step(step: float) -> None:
    """Raise ValueError if `step`, metres between samples of a ray, is out of range."""
    if not FINEST_STEP <= step <= COARSEST_STEP:
        raise ValueError(f"the step is {step} m: choose {FINEST_STEP} to {COARSEST_STEP}")
