"""Draws a sheet of the people that `primdiffusion people` makes, from successive seeds, with lowered arms.

`python benchmarks/people_sheet.py --assets DIR --out people.png` draws 64 of them, not hand-picked, with the package's
rasteriser and a simple light. `--flat` leaves the light out, as captures under uniform light do; `--heads` draws only
heads; `--poses F.npz` poses the people by a file of SMPL poses [N, 72] (key `poses`), evenly spaced.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.people import Person, load_base_mesh, make_person, open_assets
from primdiffusion.raster.rasterise import TriangleSoup, draw, flatten, shade

YAW, PITCH, FIELD_OF_VIEW = math.radians(28), math.radians(6), math.radians(26)
SUPERSAMPLE = 3
BACKGROUND = 0.18
"""Linear grey."""
HEIGHT = 2.15
"""Metres shown in a picture of a whole person, at the person's distance."""
ARMS_DOWN = {"left_collar": 0.1, "left_shoulder": 1.05, "right_collar": -0.1, "right_shoulder": -1.05}
"""Rotations about -z in radians."""


def arms_down() -> np.ndarray:
    """[24, 3] axis-angle: standing, with lowered arms."""
    theta = np.zeros((J, 3))
    for name, angle in ARMS_DOWN.items():
        theta[JOINT_NAMES.index(name), 2] = -angle
    return theta


def posed(person: Person, theta: np.ndarray) -> TexturedMesh:
    """The mesh of a person in a pose, [24, 3] axis-angle."""
    shaped = default_body().shape(torch.from_numpy(person.betas).float())
    pose = BodyPose.from_axis_angle(torch.from_numpy(theta).float().flatten())
    return person.mesh.posed(shaped.pose(pose).skinning.numpy())


def view_of(mesh: TexturedMesh, width: int, height: int, heads: bool) -> tuple[Camera, np.ndarray]:
    """A camera to the front and the side, at the same distance for every person, and the direction to it."""
    low, high = mesh.bounds
    eyes = next(part for part in mesh.parts if part.name == "eyes").vertices.mean(0)
    middle = (low + high) / 2
    aim = np.array([middle[0], low[1] + 0.48 * HEIGHT, middle[2]])
    extent, target = (0.4, eyes + np.array([0, 0.02, -0.06])) if heads else (HEIGHT, aim)
    direction = np.array([math.sin(YAW) * math.cos(PITCH), math.sin(PITCH), math.cos(YAW) * math.cos(PITCH)])
    place = target + direction * extent / 2 / math.tan(FIELD_OF_VIEW / 2)
    place, target = (torch.from_numpy(point).float() for point in (place, target))
    return look_at(place, target, vertical_fov=FIELD_OF_VIEW, width=width, height=height), direction


def picture(mesh: TexturedMesh, width: int, height: int, heads: bool, lit: bool) -> np.ndarray:
    """The person's picture, [height, width, 3] bytes."""
    camera, direction = view_of(mesh, width * SUPERSAMPLE, height * SUPERSAMPLE, heads)
    soup = flatten(mesh)
    fragments = draw(soup, camera)
    rgb = shade(soup, fragments)
    if lit:
        normal = np.einsum("hwk,hwkc->hwc", fragments.barycentric, normals(soup)[soup.faces[fragments.face]])
        rgb = rgb * light(normal, direction)[..., None]
    rgb = np.where((fragments.face >= 0)[..., None], rgb, BACKGROUND)
    blocks = rgb.reshape(height, SUPERSAMPLE, width, SUPERSAMPLE, 3).mean((1, 3))
    return np.rint(encode_srgb(np.clip(blocks, 0, 1)) * 255).astype(np.uint8)


def normals(soup: TriangleSoup) -> np.ndarray:
    """[V, 3] smooth normals, not of unit length."""
    corners = soup.vertices[soup.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(soup.vertices)
    for corner in range(3):
        np.add.at(total, soup.faces[:, corner], across)
    return total


def light(normal: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """[H, W] brightness: a lamp above the camera's left shoulder and a bright sky."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    unit = np.where((unit @ direction)[..., None] < 0, -unit, unit)
    lamp = direction + np.array([0, 0.8, 0]) - 0.7 * np.cross([0, 1, 0], direction)
    return 0.5 + 0.15 * unit[..., 1] + 0.55 * np.clip(unit @ (lamp / np.linalg.norm(lamp)), 0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first person")
    parser.add_argument("--columns", type=int, default=16)
    parser.add_argument("--height", type=int, default=260, help="pixels for each person")
    parser.add_argument("--heads", action="store_true")
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--poses", type=Path, help="npz with poses [N, 72]")
    arguments = parser.parse_args()
    assets, base = open_assets(arguments.assets), load_base_mesh()
    poses = [arms_down()]
    if arguments.poses:
        with np.load(arguments.poses, allow_pickle=False) as file:
            poses = file["poses"].reshape(-1, J, 3)
    width = arguments.height if arguments.heads or arguments.poses else arguments.height // 2
    cells = []
    for number in range(arguments.count):
        person = make_person(assets, base, arguments.seed + number)
        mesh = posed(person, poses[number * len(poses) // arguments.count])
        cells.append(picture(mesh, width, arguments.height, arguments.heads, not arguments.flat))
    cells += [np.full_like(cells[0], cells[0][0, 0])] * (-len(cells) % arguments.columns)
    rows = [np.concatenate(cells[i : i + arguments.columns], 1) for i in range(0, len(cells), arguments.columns)]
    sheet = Image.fromarray(np.concatenate(rows, 0))
    palette = sheet.quantize(256, kmeans=2)
    sheet.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(arguments.out, optimize=True)


if __name__ == "__main__":
    main()
