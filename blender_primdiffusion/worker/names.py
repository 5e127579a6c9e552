"""Names that the child knows: what the extension's menus offer. The backend's own lists are the originals."""

from __future__ import annotations

SAMPLERS = ("ddim", "dpmpp_2m", "ddpm")
"""How noise can be taken away; the first is the default."""
TRANSFERS = ("texture", "garment")
"""What one person can get from another; the first is the default."""
WHOLE_PARTS = (
    "face", "hair", "neck", "torso", "upper_arms", "forearms", "hands", "thighs", "shins", "feet", "hips",
    "head", "arms", "legs", "top", "bottom", "shoes", "clothes", "skin",
)  # fmt: skip
SIDED_PARTS = (
    "left_upper_arm", "right_upper_arm", "left_forearm", "right_forearm", "left_hand", "right_hand",
    "left_thigh", "right_thigh", "left_shin", "right_shin", "left_foot", "right_foot",
)  # fmt: skip
PARTS = (*WHOLE_PARTS, *SIDED_PARTS)
"""Parts of the body, in the backend's order."""
