"""The backend by itself: a human's files, and where `place_skinned` puts the boxes in random poses.

python boxes_oracle.py FOLDER CASES: writes person.human.safetensors and cases.npz in FOLDER/default and in FOLDER/own,
whose human has a body of the user's, with pose-dependent correctives, in body.safetensors.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.human import Human, place_skinned, pose_body
from primdiffusion.human_file import save_body, save_human
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.primitives.body_setup import BodyFiles, BodySetup, FileFingerprint
from primdiffusion.primitives.primitives import Payload


def write(folder: Path, count: int, own: bool) -> None:
    """A human and its cases."""
    folder.mkdir()
    g = torch.Generator().manual_seed(7)
    setup = None
    if own:
        body, anchors = default_body(), default_anchors()
        basis = 0.002 * torch.randn(len(body.template), 3, 207, generator=g)
        bigger = dataclasses.replace(anchors, rest_half_extent=anchors.rest_half_extent * 1.25)
        fingerprint = FileFingerprint("smpl.npz", "0" * 64)
        setup = BodySetup(dataclasses.replace(body, pose_basis=basis), bigger, BodyFiles(fingerprint, (fingerprint,)))
    payload = Payload(
        torch.rand(1024, 3, 8, 8, 8, generator=g),
        100 * torch.rand(1024, 8, 8, 8, generator=g),
        0.8 + 0.4 * torch.rand(1024, 3, generator=g),
    )
    human = Human(payload, torch.randn(10, generator=g), {"seed": 1, "full_density": 100.0}, setup)
    save_human(folder / "person.human.safetensors", human)
    if setup is not None:
        save_body(folder / "body.safetensors", setup.body, setup.anchors)
    cases = {name: [] for name in ("betas", "joints", "object", "position", "rotation", "half_extent", "density_scale")}
    for case in range(count):
        betas = human.betas if case % 3 == 0 else 1.5 * torch.randn(10, generator=g)
        pose = BodyPose.from_axis_angle(0.4 * torch.randn(72, generator=g), torch.randn(3, generator=g))
        person = reshape_human(human, betas)
        joints = pose_body(betas, pose, None if setup is None else setup.body).skinning[:, :3]
        if case % 4 == 3:  # bones that are stretched and sheared
            joints = joints + 0.05 * torch.randn(24, 3, 4, generator=g)
        linear = (0.3 + 0.2 * case) * torch.eye(3)
        if case % 2:
            linear = linear + 0.2 * torch.randn(3, 3, generator=g)
        if case % 5 == 4:
            linear[:, 0] *= -1
        world = torch.cat([linear, torch.randn(3, 1, generator=g)], 1)
        boxes = place_skinned(person, joints, world)
        found = (betas, joints, world, boxes.position, boxes.rotation, boxes.half_extent)
        scale = boxes.density.double().sum() / payload.density.double().sum()
        for name, value in zip(cases, (*found, scale), strict=True):
            cases[name].append(value.numpy())
    np.savez(folder / "cases.npz", **{name: np.stack(values) for name, values in cases.items()})


if __name__ == "__main__":
    for kind in ("default", "own"):
        write(Path(sys.argv[1]) / kind, int(sys.argv[2]), kind == "own")
