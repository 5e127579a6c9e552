"""Writes the extension's built-in poses to a file of the backend: `python -m scripts.bake_poses`.

They are defined as joint angles in `blender_primdiffusion/motion/poses.py`; with the file, both programs capture the
same poses.
"""

from __future__ import annotations

import json
from pathlib import Path

from blender_primdiffusion.motion.poses import BUILT_IN, built_in_poses

OUT = Path(__file__).resolve().parents[2] / "backend" / "primdiffusion" / "capture" / "data" / "poses.json"

if __name__ == "__main__":
    turns = built_in_poses().axis_angle().reshape(len(BUILT_IN), -1)
    lines = [
        json.dumps(name) + ": [" + ", ".join(f"{value:.6g}" for value in pose) + "]"
        for name, pose in zip(BUILT_IN, turns + 0.0, strict=True)
    ]
    OUT.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
