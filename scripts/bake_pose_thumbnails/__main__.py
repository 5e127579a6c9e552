"""Renders the previews of the extension's pose library: `python -m scripts.bake_pose_thumbnails`.

A person from the default checkpoint is drawn in each pose by our own marcher; the pictures are 160 pixels wide.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch
from PIL import Image
from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.human import framing, generate, place
from primdiffusion.render.march import march

from blender_primdiffusion.motion.poses import LIBRARY

OUT = Path(__file__).resolve().parents[2] / "blender_primdiffusion" / "motion" / "data" / "thumbnails"
SEED, YAW_DEGREES, SIZE = 7, 26, 160
_COLOURS = 96
"""Size of a picture's palette: the file is a third as large without a visible difference."""


def main() -> None:
    """Writes a PNG for each pose and replaces the existing ones."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    human = generate(load_checkpoint(None), SEED)
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "large.png"
        for name, pose in LIBRARY.items():
            rotations = torch.from_numpy(pose.rotations()).float()
            primitives = place(human, BodyPose(rotations, torch.zeros(3)))
            march(primitives, framing(primitives, YAW_DEGREES, 2 * SIZE, 2 * SIZE)).save(large)
            small = Image.open(large).resize((SIZE, SIZE), Image.Resampling.LANCZOS)
            small.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE).save(out / f"{name}.png", optimize=True)
    print(f"{len(LIBRARY)} pictures, {sum(path.stat().st_size for path in out.glob('*.png')) / 1e3:.0f} kB, in {out}")


if __name__ == "__main__":
    main()
