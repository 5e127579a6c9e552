"""Writes the built-in poses and motions: `python -m scripts.bake_poses`.

From angles of limbs (`poses.py`) and formulas (`motions.py`): the poses of captures as JSON, for both programs, four
motions as AMASS files, and pose assets with pictures of a person from the default checkpoint, drawn by our own marcher.
Needs `bpy` and torch.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import bpy
import numpy as np
import torch
from blender_primdiffusion.formats.poses import motion
from blender_primdiffusion.formats.poses.rotation import to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
from PIL import Image
from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.human import framing, generate, place
from primdiffusion.render.march import march

from blender_primdiffusion.motion.poses import grounding
from blender_primdiffusion.scene.armature import build_armature, keyframe_poses
from blender_primdiffusion.scene.convention import points_to_blender

from . import motions
from .poses import BUILT_IN, LIBRARY

DATA = Path(__file__).resolve().parents[2] / "blender_primdiffusion" / "motion" / "data"
SEED, YAW_DEGREES, SIZE = 7, 26, 160
_COLOURS = 96
"""Size of a picture's palette: the file is smaller without a visible difference."""


def main() -> None:
    """Write all files, or the kinds named."""
    kinds = {"json": write_json, "motions": write_motions, "assets": write_assets}
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", choices=kinds, default=list(kinds))
    DATA.mkdir(parents=True, exist_ok=True)
    for kind in parser.parse_args().kinds:
        kinds[kind]()


def write_json() -> None:
    """The poses of captures."""
    lines = []
    for name, pose in BUILT_IN.items():
        turns = to_axis_angle(pose.rotations()).ravel() + 0.0
        lines.append(f'"{name}": [' + ", ".join(f"{value:.6g}" for value in turns) + "]")
    motion.BUILT_IN_FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def write_motions() -> None:
    """One round of each motion."""
    up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    for make in (motions.walk, motions.idle, motions.wave, motions.turn):
        motion = make()
        turned = np.array(motion.rotations)
        turned[:, 0] = up @ turned[:, 0]
        np.savez_compressed(
            DATA / f"{make.__name__}.npz",
            poses=to_axis_angle(turned).reshape(len(motion), -1).astype(np.float32),
            trans=((motion.translations + REST_JOINTS[0]) @ up.T - REST_JOINTS[0]).astype(np.float32),
            mocap_framerate=np.float32(motion.fps),
        )


def write_assets() -> None:
    """The asset library: a file with an action for each pose. The armature only gives the bones' axes."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = build_armature("Poses", points_to_blender(REST_JOINTS))
    bpy.context.scene.collection.objects.link(armature)
    human = generate(load_checkpoint(None), SEED)
    actions = set()
    with tempfile.TemporaryDirectory() as folder:
        for name, pose in LIBRARY.items():
            rotations = pose.rotations()
            action = keyframe_poses(armature, np.ones(1), rotations[None], grounding(rotations[None]), name)
            action.asset_mark()
            action.asset_data.description = "A pose of PrimDiffusion"
            action.asset_data.tags.new("pose")
            picture = Path(folder) / f"{name}.png"
            primitives = place(human, BodyPose(torch.from_numpy(rotations).float(), torch.zeros(3)))
            march(primitives, framing(primitives, YAW_DEGREES, 2 * SIZE, 2 * SIZE)).save(picture)
            small = Image.open(picture).resize((SIZE, SIZE), Image.Resampling.LANCZOS)
            small.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE).save(picture)
            with bpy.context.temp_override(id=action):
                bpy.ops.ed.lib_id_load_custom_preview(filepath=str(picture))
            actions.add(action)
    bpy.data.libraries.write(str(DATA / "poses.blend"), actions, fake_user=True, compress=True)


if __name__ == "__main__":
    main()
