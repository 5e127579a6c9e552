"""Measures how upright humans from one picture of a tilted camera stand, and whether a fit that failed says so.

`python benchmarks/upright.py --assets DIR --json F --sheet F.jpg` draws humans that no training set has, each on both
feet in one of six poses, by cameras as people hold them: pitch uniform within 15 degrees, roll within 4, a lens of 24
to 85 mm on film of 36 mm, 1.5 +- .3 m above the floor, so far away that the whole human is in the picture (others are
drawn again, but with the same pitch). Every second picture states its lens in its EXIF data. The fit starts from
nothing else. Over humans:

    lean_error_median_deg, lean_error_p90_deg    angle between the torso (pelvis to neck) and the true one
    feet_plane_median_cm, feet_plane_p90_cm      difference of the feet's lowest points in height, less the true one
    pitch_error_median_deg                       of the camera
    camera_error_px                              distance of the joints in the picture, of 512 pixels
    front_psnr                                   the human in the picture, over the figure, dB
    fit_seconds_cpu                              CPU time of the fit of the posture

`python benchmarks/upright.py several --assets DIR --json F --sheet F.jpg` makes one human from three pictures, front,
side and back in different poses by different cameras, and adds to the figures in F:

    several_turn_error_deg                       of the body about the vertical, the largest
    several_front_psnr, ..._side_psnr, ..._back_psnr    that human in each picture
    front_only_side_psnr, front_only_back_psnr   a human from the front's picture alone, in the poses of the others

The sheet has a row for each human: the picture, ours in it, ours and the true posture from the side, with the floor
level. That of several pictures has a row for each picture: it, the human from all, and that from the front alone.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from figure_metrics import figure_psnr
from from_pictures import GREY, SEED, add, options
from jaxtyping import Float
from PIL import ExifTags, Image
from primdiffusion.body.model import BodyPose, PosedBody, default_body
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.photograph import FILM_MM, Photograph, read_photographs
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.render import srgb_bytes
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.poses.motion import built_in_vectors
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.human import Human, place
from primdiffusion.people.assets import open_assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import make_person
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.raster.rasterise import figure_from_mesh
from primdiffusion.reconstruction.from_captures import reconstruct
from primdiffusion.reconstruction.from_pictures import fit_posture_in, initial_pose, person_in
from primdiffusion.reconstruction.posture_fit import Posture, each
from primdiffusion.reconstruction.posture_start import views_of
from primdiffusion.render.march import march
from record import report, run
from torch import Tensor

POSES = ("standing", "A", "hands on hips", "waving", "near T", "walking")
PITCH_DEG, ROLL_DEG, LENS_MM, HEIGHT_M = 15.0, 4.0, (24.0, 85.0), (1.5, 0.3)
WIDTH, HEIGHT = 640, 960
FIGURE = (0.45, 0.85)
"""Heights of the human as shares of the picture's."""
MARGIN_PX = 20
TILE = 256
SIDES = {"front": 0.0, "side": 100.0, "back": 170.0}
"""Degrees by which a body is turned in three pictures."""


class Case(NamedTuple):
    """A picture and the truth, in a world whose y is up and whose floor is y = 0."""

    photograph: Photograph
    posed: PosedBody
    view: View
    pitch: float
    """Degrees, downwards."""


def main() -> None:
    rows, path = measured(8, of_one)
    of = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    figures: dict[str, float | int] = {
        "lean_error_median_deg": np.median(of["lean_error_deg"]),
        "lean_error_p90_deg": np.quantile(of["lean_error_deg"], 0.9),
        "feet_plane_median_cm": np.median(of["feet_plane_cm"]),
        "feet_plane_p90_cm": np.quantile(of["feet_plane_cm"], 0.9),
        "pitch_error_median_deg": np.median(of["pitch_error_deg"]),
        **{name: of[name].mean() for name in ("camera_error_px", "front_psnr", "fit_seconds_cpu")},
    }
    report({name: round(float(value), 3) for name, value in figures.items()} | {"people": len(rows)}, path)


def several() -> None:
    rows, path = measured(6, of_sides)
    figures = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    figures |= {"several_turn_error_deg": max(row["several_turn_error_deg"] for row in rows)}
    add({name: round(value, 3) for name, value in figures.items()} | {"several_people": len(rows)}, path)


def measured(people: int, of: Callable[..., dict[str, float]]) -> tuple[list[dict[str, float]], Path | None]:
    """Figures of each human, and where the record goes; the command line says how many, and where their sheet goes."""
    parser = options(people)
    parser.add_argument("--sheet", type=Path, help="picture of the humans")
    arguments = parser.parse_args()
    assets, model = open_assets(arguments.assets, required_meshes()), load_checkpoint(arguments.checkpoint)
    rows, sheet = [], []
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(arguments.people):
            rows.append(of(model, assets, number, Path(scratch), sheet))
            print(number, {key: round(value, 2) for key, value in rows[-1].items()}, flush=True)
    if arguments.sheet is not None:
        Image.fromarray(np.concatenate(sheet)).save(arguments.sheet, quality=88)
    return rows, arguments.json


def of_one(model: DiffusionModel, assets, number: int, folder: Path, sheet: list[np.ndarray]) -> dict[str, float]:
    """Figures of a human from one picture, whose row is added to the sheet."""
    case, began = drawn(assets, number, folder), time.process_time()
    start = initial_pose([case.photograph], model)
    posture = fit_posture_in(model, [case.photograph], start, lambda: None).posture
    seconds = time.process_time() - began
    human = reconstruct(model, person_in([case.photograph], posture))
    sheet.append(sheet_row(human, case, posture))
    return errors(case, posture) | {"front_psnr": front_psnr(human, case, posture), "fit_seconds_cpu": seconds}


def drawn(assets, number: int, folder: Path, turned: float = 0.0, other: int = 0) -> Case:
    """Draw a human, turned by so many degrees about the vertical, save the picture with alpha, and read it.

    With `other`, in another pose and by another camera.
    """
    person, rng = make_person(assets, load_base_mesh(), SEED + number), np.random.default_rng(number + 1000 * other)
    names = list(built_in_vectors())
    pose = built_in_poses().map(lambda values: values[names.index(POSES[(number + other) % len(POSES)])])
    turn = axis_angle_to_matrix(torch.tensor([0.0, math.radians(turned), 0.0]))
    pose = BodyPose(torch.cat([turn @ pose.joint_rotation[:1], pose.joint_rotation[1:]]), pose.translation)
    body = default_body().shape(torch.from_numpy(person.betas).float())
    floor = body.pose(pose).vertices[:, 1].min()
    posed = body.pose(BodyPose(pose.joint_rotation, torch.tensor([0.0, -float(floor), 0.0])))
    pitch = rng.uniform(-PITCH_DEG, PITCH_DEG)
    view, lens = held_camera(posed.vertices.numpy(), pitch, rng)
    seen = figure_from_mesh(person.mesh).posed(posed.skinning.double().numpy())(view, 3)
    alpha = seen.alpha.clip(0, 1)[..., None]
    straight = srgb_bytes(np.where(alpha > 0, seen.rgb / np.maximum(alpha, 1e-3), 0.1).clip(0, 1))
    exif, path = Image.Exif(), folder / f"{number}_{other}.png"
    if number % 2:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: round(lens)}
    picture = Image.fromarray(np.concatenate([straight, (255 * alpha).round().astype(np.uint8)], -1))
    picture.save(path, exif=exif)
    return Case(read_photographs([path])[0], posed, view, pitch)


def of_sides(model: DiffusionModel, assets, number: int, folder: Path, sheet: list[np.ndarray]) -> dict[str, float]:
    """Figures of a human from three pictures, whose rows are added to the sheet."""
    cases = [drawn(assets, number, folder, turned, i) for i, turned in enumerate(SIDES.values())]
    photographs = read_photographs([case.photograph.path for case in cases])
    cases = [case._replace(photograph=one) for case, one in zip(cases, photographs, strict=True)]
    posture = fit_posture_in(model, photographs, initial_pose(photographs, model), lambda: None).posture
    poses, cameras = list(each(posture.pose)), list(each(posture.camera))
    front = Posture(posture.pose.map(lambda values: values[:1]), posture.betas, stack(cameras[:1]))
    humans = reconstruct(model, person_in(photographs, posture)), reconstruct(model, person_in(photographs[:1], front))
    row = {"several_turn_error_deg": 0.0}
    for side, case, pose, camera in zip(SIDES, cases, poses, cameras, strict=True):
        off = abs(heading(pose.joint_rotation[0]) - heading(case.posed.joints[0, :3, :3]))
        row["several_turn_error_deg"] = max(row["several_turn_error_deg"], min(off, 360 - off))
        tiles, mask = [true_square(case)], torch.from_numpy(case.photograph.rgba[..., 3]) > 127
        for name, human in zip(("several", "front_only"), humans, strict=True):
            tiles.append(picture(human, pose, camera))
            row[f"{name}_{side}_psnr"] = float(figure_psnr(tiles[-1], tiles[0], mask))
        sheet.append(tiled(tiles))
    return row


def heading(rotation: Float[Tensor, "3 3"]) -> float:
    """Degrees by which a body is turned about the vertical."""
    return math.degrees(math.atan2(rotation[0, 2], rotation[2, 2]))


def held_camera(points: Float[np.ndarray, "V 3"], pitch: float, rng: np.random.Generator) -> tuple[View, float]:
    """A camera of this pitch, in degrees downwards, that sees all points, and its lens in mm."""
    while True:
        lens, height = math.exp(rng.uniform(*np.log(LENS_MM))), rng.normal(*HEIGHT_M)
        focal, share, roll = lens / FILM_MM * HEIGHT, rng.uniform(*FIGURE), rng.uniform(-ROLL_DEG, ROLL_DEG)
        away = focal * np.ptp(points[:, 1]) / (share * HEIGHT)
        turn = axis_angle_to_matrix(torch.tensor([math.radians(pitch), 0.0, 0.0]).double())
        turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, math.radians(roll)]).double()) @ turn
        rotation = turn.numpy() @ np.diag([1.0, -1.0, -1.0])
        place = np.array([rng.uniform(-0.1, 0.1) * away, height, away])
        intrinsics = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
        view = View(intrinsics, rotation, -rotation @ place, WIDTH, HEIGHT)
        pixels, depth = view.project(points)
        edge = np.array([WIDTH, HEIGHT]) - MARGIN_PX
        if depth.min() > 0.5 and (pixels > MARGIN_PX).all() and (pixels < edge).all():
            return view, lens


def found_body(posture: Posture) -> PosedBody:
    return default_body().shape(posture.betas).pose(posture.pose.map(lambda values: values[0]))


def torso(posed: PosedBody) -> Float[Tensor, "3"]:
    """Unit vector from the pelvis to the neck."""
    places = posed.joints[:, :3, 3]
    return torch.nn.functional.normalize(places[JOINT_NAMES.index("neck")] - places[0], dim=0)


def feet_difference(posed: PosedBody) -> float:
    """Height of the left foot's lowest point over the right one's, metres."""
    nearest = default_body().skin_weights.argmax(1)
    lowest = []
    for side in ("left", "right"):
        parts = [JOINT_NAMES.index(f"{side}_{name}") for name in ("ankle", "foot")]
        lowest.append(posed.vertices[(nearest == parts[0]) | (nearest == parts[1]), 1].min())
    return float(lowest[0] - lowest[1])


def errors(case: Case, posture: Posture) -> dict[str, float]:
    found, (view,) = found_body(posture), views_of([case.photograph], posture.camera)
    angle = math.degrees(math.acos(min(1.0, float(torso(found) @ torso(case.posed)))))
    pixels = [one.project(body.joints[:, :3, 3].numpy())[0] for one, body in ((view, found), (case.view, case.posed))]
    return {
        "lean_error_deg": angle,
        "forward_deg": math.degrees(math.asin(float(torso(found)[2])) - math.asin(float(torso(case.posed)[2]))),
        "feet_plane_cm": 100 * abs(feet_difference(found) - feet_difference(case.posed)),
        "pitch_error_deg": abs(-math.degrees(math.asin(view.rotation[2, 1])) - case.pitch),
        "camera_error_px": float(np.linalg.norm(pixels[0] - pixels[1], axis=1).mean()) * 512 / HEIGHT,
    }


@torch.no_grad()
def picture(human: Human, pose: BodyPose, camera: Camera) -> Float[Tensor, "H W 3"]:
    seen = march(place(human, pose), camera)
    return encode_srgb((seen.rgb + (1 - seen.alpha[..., None]) * GREY).clamp(0, 1))


def true_square(case: Case) -> Float[Tensor, "H W 3"]:
    rgba = torch.from_numpy(case.photograph.rgba).float() / 255
    return encode_srgb((decode_srgb(rgba[..., :3]) + (1 - rgba[..., 3:]) * GREY).clamp(0, 1))


def front_psnr(human: Human, case: Case, posture: Posture) -> float:
    pose, camera = (record.map(lambda values: values[0]) for record in (posture.pose, posture.camera))
    mask = torch.from_numpy(case.photograph.rgba[..., 3]) > 127
    return float(figure_psnr(picture(human, pose, camera), true_square(case), mask))


def sheet_row(human: Human, case: Case, posture: Posture) -> np.ndarray:
    """The kept square, ours in it, ours from the left of its camera, and the true posture likewise."""
    pose, camera = (record.map(lambda values: values[0]) for record in (posture.pose, posture.camera))
    tiles = [true_square(case), picture(human, pose, camera), picture(human, pose, beside(found_body(posture)))]
    true = case.posed.vertices[default_body().faces[::3]].mean(1)
    pixels, _ = beside(case.posed).project(true)
    shadow = torch.ones(TILE, TILE, 3)
    column, row = pixels.long().clamp(0, TILE - 1).T
    shadow[row, column] = 0.3
    return tiled([*tiles, shadow])


def tiled(tiles: list[Tensor]) -> np.ndarray:
    images = [Image.fromarray((255 * tile).round().to(torch.uint8).numpy()) for tile in tiles]
    return np.concatenate([np.asarray(image.resize((TILE, TILE), Image.Resampling.BOX)) for image in images], 1)


def beside(posed: PosedBody) -> Camera:
    """A level camera at the left of the body."""
    middle = (posed.vertices.amin(0) + posed.vertices.amax(0)) / 2
    away = torch.tensor([6.0, 0.0, 0.0])
    return look_at(middle + away, middle, vertical_fov=math.radians(20), width=TILE, height=TILE)


if __name__ == "__main__":
    run(main, several=several)
