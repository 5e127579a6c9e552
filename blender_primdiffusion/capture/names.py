"""Names of what is captured, for those who offer it and need no more."""

from __future__ import annotations

PASSES = ("img", "mask", "depth", "normal", "part")
LAYOUTS = ("nerf", "opencv", "colmap")
"""Camera files of other projects; the released code's files are always written."""
