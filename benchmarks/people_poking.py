"""How much skin shows through cloth: pixels where skin lies just in front of a garment, per 10,000 pixels of garment.

`python benchmarks/people_poking.py --assets DIR [--poses F.npz] --json F`. Skin counts as poking through where it faces
the camera and cloth follows less than REACH behind it, which is so where cloth has sunk into the body and nearly
nowhere else (a hand laid on a hip counts, too, so that figures of poses are upper bounds). The rest pose, arms let
down, and the poses of a file of SMPL poses [N, 72] (key `poses`), those that lie farthest apart.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from people_sheet import arms_down, posed
from primdiffusion.body.model import J
from primdiffusion.geometry.camera import look_at
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.people import load_base_mesh, make_person, open_assets
from primdiffusion.raster.rasterise import draw, flatten
from record import tell

REACH = 0.02
"""Metres."""
FACING = 0.3
"""Least cosine between the skin's normal and the way to the camera."""
YAWS, SIZE, FIELD_OF_VIEW = (0, 90, 180, 270), 400, math.radians(28)
CLOTHES = ("outfit", "shoes")


def poking(mesh: TexturedMesh, yaw: float) -> tuple[int, int]:
    """Pixels of skin that pokes through and pixels of cloth, seen from `yaw` degrees around the person."""
    low, high = mesh.bounds
    way = np.array([math.sin(math.radians(yaw)), 0, math.cos(math.radians(yaw))])
    target = (low + high) / 2
    place = target + way * 1.08 * (high - low).max() / 2 / math.tan(FIELD_OF_VIEW / 2)
    position, aim = (torch.from_numpy(point).float() for point in (place, target))
    camera = look_at(position, aim, vertical_fov=FIELD_OF_VIEW, width=SIZE, height=SIZE)
    clothes = tuple(part for part in mesh.parts if part.name in CLOTHES)
    body = tuple(part for part in mesh.parts if part.name == "body")
    soup = flatten(TexturedMesh((*body, *clothes)))
    seen, behind = draw(soup, camera), draw(flatten(TexturedMesh(clothes)), camera).depth
    hit = seen.face >= 0
    skin = hit & (soup.part[seen.face] == 0)
    corners = soup.vertices[soup.faces[seen.face]]
    normal = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    facing = normal @ way > FACING * np.linalg.norm(normal, axis=-1)
    near = behind < np.where(hit, seen.depth, 0) + REACH
    return int((skin & facing & near).sum()), int((hit & ~skin).sum())


def farthest(poses: np.ndarray, count: int) -> list[np.ndarray]:
    """Poses [N, 24, 3] that lie far apart, the strongest first, upright."""
    poses = poses.copy()
    poses[:, 0] = 0
    flat = poses.reshape(len(poses), -1)
    picked = [int(np.linalg.norm(flat, axis=1).argmax())]
    distance = np.linalg.norm(flat - flat[picked[0]], axis=1)
    while len(picked) < min(count, len(poses)):
        picked.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(flat - flat[picked[-1]], axis=1))
    return [poses[i] for i in picked]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--count", type=int, default=32)
    parser.add_argument("--poses", type=Path, help="npz with poses [N, 72]")
    parser.add_argument("--pose-count", type=int, default=6)
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    poses = {"rest": [np.zeros((J, 3))], "standing": [arms_down()]}
    if arguments.poses:
        with np.load(arguments.poses, allow_pickle=False) as file:
            poses["posed"] = farthest(file["poses"].reshape(-1, J, 3).astype(np.float64), arguments.pose_count)
    assets, base = open_assets(arguments.assets), load_base_mesh()
    shares: dict[str, list[float]] = {name: [] for name in poses}
    for seed in range(arguments.count):
        person = make_person(assets, base, seed)
        for name, group in poses.items():
            for theta in group:
                mesh = posed(person, theta)
                skin, cloth = np.sum([poking(mesh, yaw) for yaw in YAWS], axis=0)
                shares[name].append(1e4 * skin / cloth)
    figures: dict[str, float | int] = {"people": arguments.count}
    for name, values in shares.items():
        figures |= {f"{name}_poking_mean": float(np.mean(values)), f"{name}_poking_max": float(np.max(values))}
    tell(figures, arguments.json)


if __name__ == "__main__":
    main()
