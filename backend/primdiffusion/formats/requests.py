"""What requests may say, and their defaults: on the command line, in JSON-RPC and in the extension's panels."""

from typing import Literal, get_args

Sampler = Literal["ddim", "dpmpp_2m", "ddpm"]
SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)
"""The first is the default."""
Transfer = Literal["texture", "garment"]
"""What one person can get from another: colours alone, or shape too."""
TRANSFERS: tuple[Transfer, ...] = get_args(Transfer)
"""The first is the default."""
View = Literal["colour", "depth", "alpha", "boxes"]
"""What is drawn of people: their colours, their distance in colours, their coverage in grey, their boxes."""
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
"""Left and right are the person's own."""
PARTS = (*WHOLE_PARTS, *SIDED_PARTS)
"""Parts of the body, which make up regions."""

STEPS = 30
"""Of the sampler."""
GUIDANCE = 1.5
"""How strongly attributes are followed: 1 plainly, more at the cost of variety."""
AMOUNT = 0.5
"""How far a variant may be from its person: 0 the same, 1 hardly anything in common."""
FRACTION = 0.5
"""Of the way from one person to another."""
CAPTURE_VIEWS = 8
"""Cameras that the encoder looks at."""
PICTURE_SIZE = 512
"""Pixels a side."""
VARIATION_SIZE = 256
"""Pixels a side."""
RAY_STEP = 0.004
"""Metres between samples of a ray."""
DENSITY_GAIN = 1.6
"""Factor on density for renderers with exponential absorption."""
VOXEL = 0.006
"""Metres a side, of the grids that people are merged into and that proxies are found on. Half of it shows more of the
primitives' own voxels (2 to 14 mm) at eight times the memory."""
TRIANGLES = 20_000
"""Of a proxy, at most."""
TEXTURE_SIZE = 2048
"""Of a proxy, pixels a side."""
GAUSSIANS = 400_000
"""At most."""
