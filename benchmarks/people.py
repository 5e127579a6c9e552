"""Measures how well primitives represent a dressed person: marched payloads against the rasterised meshes.

`python benchmarks/people.py --assets DIR --json people.json` makes people from seeds that no training set uses and
draws each from directions that `from_mesh` does not use, at rest and in a pose (the mesh moved by skinning, the
primitives by the posed body). `iou` is of the silhouettes (alpha over one half). `psnr` is of sRGB-encoded pictures on
black inside the bounding box of the mesh, `psnr_whole` of the whole picture and `psnr_shared` of the pixels in both
silhouettes. `--quick` takes 4 people from 2 sides. `--pictures DIR` saves mesh and payload side by side.

`python benchmarks/people.py sheet --assets DIR --out people.png` draws a sheet of the 64 people that `primdiffusion
people` makes from successive seeds, not hand-picked, with lowered arms and a simple light. `--flat` leaves the light
out, as captures under uniform light do; `--heads` draws only heads; `--poses F.npz` poses the people by a file of SMPL
poses [N, 72] (key `poses`), evenly spaced.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry import image
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import Person, make_person
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.from_mesh import colour, surface_field
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.raster.shade import TriangleSoup, draw, flatten, shade
from primdiffusion.render.image import Rendering
from primdiffusion.render.march import march
from record import command_line, report, run

Result = TypeVar("Result")
FIRST_SEED = 10_000_000
"""Training sets count from 0."""
DIRECTIONS = ((20, 10), (110, 5), (200, 15), (290, -10))
"""Yaw and pitch of the cameras in degrees; none is a direction of from_mesh."""
SIZE = 512
FIELD_OF_VIEW = math.radians(30)
BENDS = {
    "left_collar": (0, 0, -0.3),
    "right_collar": (0, 0, 0.3),
    "left_shoulder": (0, 0, -0.7),
    "right_shoulder": (0, 0.4, 0.7),
    "left_elbow": (0, -0.8, 0),
    "right_elbow": (0, 0.6, 0),
    "left_hip": (-0.5, 0, 0.05),
    "right_hip": (0.3, 0, -0.05),
    "left_knee": (0.7, 0, 0),
    "right_knee": (0.4, 0, 0),
    "spine2": (0, 0.2, 0),
    "head": (0.1, 0.3, 0),
}
"""The pose: axis-angle (radians) by joint; arms lowered and bent, a step forward, the upper body and head turned."""
YAW, PITCH, SHEET_FIELD_OF_VIEW = math.radians(28), math.radians(6), math.radians(26)
SUPERSAMPLE = 3
BACKGROUND = 0.18
"""Linear grey."""
HEIGHT = 2.15
"""Metres shown in a picture of a whole person, at the person's distance."""
ARMS_DOWN = {"left_collar": 0.1, "left_shoulder": 1.05, "right_collar": -0.1, "right_shoulder": -1.05}
"""Rotations about -z in radians."""


def camera_at(bounds: np.ndarray, yaw: float, pitch: float) -> Camera:
    """A camera aimed at the middle of `bounds` from yaw and pitch in degrees; the bounds fit with a tenth to spare."""
    middle = bounds.mean(0)
    distance = 1.1 * (bounds[1] - bounds[0]).max() / 2 / math.tan(FIELD_OF_VIEW / 2)
    yaw, pitch = math.radians(yaw), math.radians(pitch)
    direction = np.array([math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)])
    position, target = (torch.from_numpy(point).float() for point in (middle + distance * direction, middle))
    return look_at(position, target, vertical_fov=FIELD_OF_VIEW, width=SIZE, height=SIZE)


def compare(drawn: image.Image, marched: Rendering) -> dict[str, float]:
    first, second = drawn.alpha > 0.5, marched.alpha.numpy() > 0.5
    squared = (encoded(drawn.rgb) - encoded(marched.rgb.numpy())) ** 2
    rows, columns = np.nonzero(first)
    box = squared[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return {
        "iou": (first & second).sum() / (first | second).sum(),
        "psnr": psnr(box),
        "psnr_whole": psnr(squared),
        "psnr_shared": psnr(squared[first & second]),
        "missing": (first & ~second).sum() / first.sum(),
        "surplus": (second & ~first).sum() / first.sum(),
    }


def encoded(rgb: np.ndarray) -> np.ndarray:
    """Linear colours as sRGB-encoded values, 0 ... 1."""
    return encode_srgb(np.clip(rgb, 0, 1))


def psnr(squared: np.ndarray) -> float:
    """PSNR in decibels, from squared differences of values in 0 ... 1."""
    return float(-10 * np.log10(squared.mean()))


def bent_pose() -> BodyPose:
    theta = torch.zeros(J, 3)
    for joint, axis_angle in BENDS.items():
        theta[JOINT_NAMES.index(joint)] = torch.tensor(axis_angle, dtype=torch.float32)
    return BodyPose.from_axis_angle(theta.flatten())


def measure(assets: Assets, people: int, directions: int, pictures: Path | None) -> dict[str, float | int]:
    """All figures by name: `posed_` are of the pose, `seconds_` are medians."""
    body, anchors, base = default_body(), default_anchors(), load_base_mesh()
    figures: dict[str, list[dict[str, float]]] = {"people": [], "posed": []}
    seconds: dict[str, list[float]] = {"person": [], "surface_field": [], "colour": []}
    for seed in range(FIRST_SEED, FIRST_SEED + people):
        person, seconds_person = timed(lambda seed=seed: make_person(assets, base, seed))
        shaped = body.shape(torch.from_numpy(person.betas).float())
        frames = attach(anchors, shaped.vertices, body.faces)
        field, seconds_field = timed(lambda mesh=person.mesh, frames=frames: surface_field(mesh, frames))
        payload, seconds_colour = timed(lambda field=field, mesh=person.mesh: colour(field, mesh))
        for name, value in zip(seconds, (seconds_person, seconds_field, seconds_colour), strict=True):
            seconds[name].append(value)
        posed = shaped.pose(bent_pose())
        scenes = {
            "people": (person.mesh, frames),
            "posed": (person.mesh.posed(posed.skinning.numpy()), attach(anchors, posed.vertices, body.faces)),
        }
        for name, (mesh, placed) in scenes.items():
            primitives = Primitives.place(placed, payload)
            for yaw, pitch in DIRECTIONS[:directions]:
                path = pictures and pictures / f"{name}_{seed}_{yaw}.png"
                figures[name].append(picture_of(mesh, primitives, yaw, pitch, path))
    result: dict[str, float | int] = {"people": people, "directions": directions}
    for name, rows in figures.items():
        for figure in rows[0]:
            values = [row[figure] for row in rows]
            result[f"{name}_{figure}_mean"] = float(np.mean(values))
        result[f"{name}_iou_min"] = float(min(row["iou"] for row in rows))
        result[f"{name}_psnr_min"] = float(min(row["psnr"] for row in rows))
    return result | {f"seconds_{name}": float(np.median(values)) for name, values in seconds.items()}


def picture_of(
    mesh: TexturedMesh, primitives: Primitives, yaw: float, pitch: float, path: Path | None
) -> dict[str, float]:
    """The figures of one view; writes mesh and payload side by side to `path`."""
    camera = camera_at(mesh.bounds, yaw, pitch)
    drawn, marched = rasterise(mesh, camera, supersample=2), march(primitives, camera)
    if path:
        pair = np.concatenate([encoded(drawn.rgb), encoded(marched.rgb.numpy())], axis=1)
        Image.fromarray(np.rint(pair * 255).astype(np.uint8)).save(path)
    return compare(drawn, marched)


def timed(call: Callable[[], Result]) -> tuple[Result, float]:
    """The result of `call`, and its seconds."""
    begin = time.perf_counter()
    result = call()
    return result, time.perf_counter() - begin


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of mesh and payload side by side")
    parser.add_argument("--quick", action="store_true", help="4 people from 2 directions, under a minute")
    arguments = parser.parse_args()
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    people, directions = (4, 2) if arguments.quick else (16, len(DIRECTIONS))
    figures = measure(open_assets(arguments.assets), people, directions, arguments.pictures)
    report(figures, arguments.json)


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
    place = target + direction * extent / 2 / math.tan(SHEET_FIELD_OF_VIEW / 2)
    place, target = (torch.from_numpy(point).float() for point in (place, target))
    return look_at(place, target, vertical_fov=SHEET_FIELD_OF_VIEW, width=width, height=height), direction


def sheet_picture(mesh: TexturedMesh, width: int, height: int, heads: bool, lit: bool) -> np.ndarray:
    """The person's picture, [height, width, 3] bytes."""
    camera, direction = view_of(mesh, width * SUPERSAMPLE, height * SUPERSAMPLE, heads)
    soup = flatten(mesh)
    fragments = draw(soup, camera)
    rgb, _ = shade(fragments, soup.textures, camera.height, camera.width)
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


def sheet_of_people() -> None:
    parser = argparse.ArgumentParser(description="Draws a sheet of people from successive seeds.")
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
        cells.append(sheet_picture(mesh, width, arguments.height, arguments.heads, not arguments.flat))
    cells += [np.full_like(cells[0], cells[0][0, 0])] * (-len(cells) % arguments.columns)
    rows = [np.concatenate(cells[i : i + arguments.columns], 1) for i in range(0, len(cells), arguments.columns)]
    sheet = Image.fromarray(np.concatenate(rows, 0))
    palette = sheet.quantize(256, kmeans=2)
    sheet.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(arguments.out, optimize=True)


if __name__ == "__main__":
    run(main, sheet=sheet_of_people)
