"""The Python API in short: generate a person, pose them, draw them from four sides.

python examples/generate_pose_render.py --out waving
"""

import argparse
from pathlib import Path

import torch
from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.human import framing, generate, place
from primdiffusion.human_file import save_human
from primdiffusion.render.march import march
from walk import walk_and_wave


def main() -> None:
    """Writes the person and four pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--size", type=int, default=512)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    human = generate(load_checkpoint(arguments.checkpoint), arguments.seed)
    save_human(arguments.out / "person.human.safetensors", human)

    rotation = torch.from_numpy(walk_and_wave(frames=48)[31]).float()
    waving = place(human, BodyPose(rotation, torch.zeros(3)))
    for degrees in (0, 90, 180, 270):
        camera = framing(waving, degrees, arguments.size, arguments.size)
        march(waving, camera).save(arguments.out / f"yaw_{degrees:03d}.png")


if __name__ == "__main__":
    main()
