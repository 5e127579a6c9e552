"""Measures humans from one plain picture: how well pose and camera are found, how the human looks, what breaks it.

`python benchmarks/plain_pictures.py --assets DIR --json F --sheet F.png` draws the humans of `from_pictures.py` from
the front, every second one in another pose than T, and saves each as a PNG with alpha: 512 x 512 pixels, no camera,
whose lens (30 degrees) is not stated and is taken for 45 degrees. The pose that is given is the true one with every
joint turned by 5 degrees (root mean square) about a random axis. Means over humans:

    camera_error_px                distance of the joints as the found pose and camera project them from the true ones
    camera_error_px_start          the same before refining
    camera_error_px_standing       the same where no pose is given, of the humans near the T pose
    picture_psnr                   eight unseen views in the true pose, as in `from_pictures.py`; the human, whose size
                                   one picture cannot tell, is scaled and moved to the true joints
    picture_known_psnr             the same with pose, shape and camera known
    picture_seconds_cpu            CPU time, refining included

And of the first --robust humans, camera error (camera_error_px_...) and PSNR (picture_psnr_...) with

    jpeg            JPEG of quality 25 in place of PNG, with the true mask
    noise           noise of .06 (standard deviation, encoded) in the picture
    eroded, dilated the mask by 4 pixels
    pose_10, pose_20 joints turned by 10 and 20 degrees
    turned_10       the whole body turned by 10 degrees about the vertical besides

`python benchmarks/plain_pictures.py spoiled --assets DIR --json F` measures some 40 spoiled pictures (--pictures) and
a third as many good ones of humans as in `upright.py`, by tilted cameras, from a standing start. They are not those by
which the limits were set. A fit is reported if it is below 85 % or left a part of the mask out:

    failed_fits_reported           share of the spoiled pictures (SPOILED) that are reported
    good_fits_reported             share of the good pictures that are reported though nothing is wrong
    cutout_iou, cutout_iou_worst   intersection over union of the true mask and of the one that is cut out of a good
                                   picture over a generated background, by the outline of the fitted body

The sheet has a row for each human: picture, ours in the picture, then two others beside the true ones.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
import upright
from figure_metrics import figure_psnr
from from_pictures import GREY, POSES, VIEW, Case, captured, case_of, over_grey
from jaxtyping import Float
from PIL import Image
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.photograph import Photograph, read_photographs
from primdiffusion.capture.reader import Views
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.human import Human, place, pose_body
from primdiffusion.people.assets import Assets, open_assets
from primdiffusion.people.wardrobe import required_meshes
from primdiffusion.reconstruction.from_captures import reconstruct
from primdiffusion.reconstruction.from_pictures import (
    POSE_FILE_PRECISION,
    InitialPose,
    fit_posture_in,
    fit_quality,
    initial_pose,
    person_in,
    person_in_pictures,
)
from primdiffusion.reconstruction.posture_fit import Posture
from primdiffusion.reconstruction.posture_start import framed, views_of, write_posture
from primdiffusion.render.march import march
from record import command_line, report, run
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

DEGREES = 5.0
"""Error of the given pose."""
SIZE = 512
OTHERS = 400
"""Number of the first human whose pictures are spoiled."""


@dataclasses.dataclass(frozen=True)
class Fault:
    """What is wrong with a picture or with what is known of it."""

    degrees: float = DEGREES
    turned: float = 0.0
    """Degrees by which the body is turned about the vertical."""
    mask: Callable[[np.ndarray], np.ndarray] = lambda mask: mask
    picture: Callable[[np.ndarray], np.ndarray] = lambda picture: picture
    quality: int | None = None
    """Of a JPEG; None for PNG."""


def noisy(picture: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 255 * 0.06, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


FAULTS: Mapping[str, Fault] = {
    "jpeg": Fault(quality=25),
    "noise": Fault(picture=noisy),
    "eroded": Fault(mask=lambda mask: ndimage.minimum_filter(mask, 9)),
    "dilated": Fault(mask=lambda mask: ndimage.maximum_filter(mask, 9)),
    "pose_10": Fault(degrees=10.0),
    "pose_20": Fault(degrees=20.0),
    "turned_10": Fault(turned=10.0),
}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--checkpoint", type=Path, help="diffusion model; the default one if omitted")
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--robust", type=int, default=4, help="humans for the figures of faults")
    parser.add_argument("--sheet", type=Path, help="PNG of the humans")
    arguments = parser.parse_args()
    model, rows, sheet = load_checkpoint(arguments.checkpoint), [], []
    with tempfile.TemporaryDirectory() as scratch:
        captures = captured(Path(scratch), arguments.assets, arguments.people)
        for number, name in enumerate(captures.subjects):
            case = case_of(captures, name, number % POSES)
            photograph = photographed(case, Path(scratch) / name, Fault())
            if not number:  # compiles the marcher and its gradients
                fit_posture_in(model, [photograph], initial_pose([photograph], model), lambda: None)
            start = given(case, photograph, model, Fault(), number)
            began = time.process_time()
            posture = fit_posture_in(model, [photograph], start, lambda: None).posture
            human = reconstruct(model, person_in([photograph], posture))
            seconds = time.process_time() - began
            views = aligned(case, human)
            row = {
                "camera_error_px": camera_error(case, photograph, posture),
                "camera_error_px_start": camera_error(case, photograph, start.posture),
                "picture_psnr": psnr(human, case, views),
                "picture_known_psnr": psnr(reconstruct(model, case.given), case),
                "picture_seconds_cpu": seconds,
            }
            if not number % POSES:
                standing = fit_posture_in(model, [photograph], initial_pose([photograph], model), lambda: None).posture
                row["camera_error_px_standing"] = camera_error(case, photograph, standing)
            for fault_name, fault in FAULTS.items() if number < arguments.robust else ():
                error, quality = with_fault(model, case, Path(scratch) / f"{name}_{fault_name}", fault, number)
                row |= {f"camera_error_px_{fault_name}": error, f"picture_psnr_{fault_name}": quality}
            rows.append(row)
            print(name, {key: round(value, 2) for key, value in row.items()}, flush=True)
            sheet.append(sheet_row(case, photograph, posture, human, views))
    names = dict.fromkeys(name for row in rows for name in row)
    figures: dict[str, float | int] = {
        name: round(float(np.mean([row[name] for row in rows if name in row])), 3) for name in names
    }
    figures |= {"people": len(rows), "people_with_faults": min(arguments.robust, len(rows))}
    if arguments.sheet is not None:
        Image.fromarray(np.concatenate(sheet)).save(arguments.sheet, quality=88)
    report(figures, arguments.json)


def spoiled() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, help="MakeHuman asset folder (or PRIMDIFFUSION_ASSETS)")
    parser.add_argument("--checkpoint", type=Path, help="diffusion model; the default one if omitted")
    parser.add_argument("--pictures", type=int, default=40)
    arguments = parser.parse_args()
    assets = open_assets(arguments.assets, required_meshes())
    report(reported(load_checkpoint(arguments.checkpoint), assets, arguments.pictures), arguments.json)


def reported(model: DiffusionModel, assets: Assets, count: int) -> dict[str, float | int]:
    """Figures of fits that say that they failed, of `count` spoiled pictures."""
    kinds, said, overlaps = [*SPOILED, GOOD, GOOD], {True: [], False: []}, []
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(math.ceil(count / len(SPOILED)) * len(kinds)):
            kind, seed = kinds[number % len(kinds)], OTHERS + number
            path = Path(scratch) / f"{number}.png"
            case = upright.drawn(assets, seed, Path(scratch), turned=180.0 if kind == "behind" else 0.0)
            rgba = np.array(Image.open(case.photograph.path))
            spoil = SPOILED.get(kind, unspoiled)
            Image.fromarray(spoil(rgba, case, np.random.default_rng(number))).save(path)
            (photograph,) = read_photographs([path])
            found = fit_posture_in(model, [photograph], initial_pose([photograph], model), lambda: None)
            quality = fit_quality(model, [photograph], found)
            said[kind != GOOD].append(bool(quality.warnings()))
            if kind == GOOD:
                overlaps.append(cutout_iou(model, rgba, photograph, found.posture, Path(scratch), number))
            print(kind, seed, quality.content(), flush=True)
    return {
        "failed_fits_reported": round(float(np.mean(said[True])), 3),
        "good_fits_reported": round(float(np.mean(said[False])), 3),
        "cutout_iou": round(float(np.mean(overlaps)), 3),
        "cutout_iou_worst": round(float(np.min(overlaps)), 3),
        "spoiled_pictures": len(said[True]),
        "good_pictures": len(said[False]),
    }


def cutout_iou(
    model: DiffusionModel, rgba: np.ndarray, photograph: Photograph, posture: Posture, folder: Path, seed: int
) -> float:
    """How well the person is cut out of the picture over a background, by the outline of the posture."""
    share, behind = rgba[..., 3:] / 255, background(*rgba.shape[:2], np.random.default_rng(seed))
    picture = (rgba[..., :3] * share + behind * (1 - share)).clip(0, 255).astype(np.uint8)
    Image.fromarray(picture).save(folder / "opaque.png")
    write_posture(folder / "posture.json", posture.pose, posture.betas, views_of([photograph], posture.camera))
    person = person_in_pictures(model, [folder / "opaque.png"], pose=folder / "posture.json", refine=False)
    found, true = person.masks_made[0] > 127, rgba[..., 3] > 127
    return float((found & true).sum() / (found | true).sum())


def background(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Noise of four sizes, with a grain of its own, and up to eight shaded rectangles: walls, doors, furniture."""
    out = rng.uniform(40, 215, 3) + np.zeros((height, width, 3))
    for size in (320, 80, 20, 4):
        small = rng.normal(size=(max(2, height // size), max(2, width // size), 3))
        layers = [
            Image.fromarray(layer.astype(np.float32)).resize((width, height)) for layer in small.transpose(2, 0, 1)
        ]
        out += np.dstack([np.asarray(layer) for layer in layers]) * rng.uniform(1, 15)
    for _ in range(rng.integers(2, 9)):
        (top, bottom), (left, right) = np.sort(rng.integers(0, height, 2)), np.sort(rng.integers(0, width, 2))
        out[top:bottom, left:right] = out[top:bottom, left:right] * rng.uniform(0.3, 0.8) + rng.uniform(0, 150, 3)
    return out


def unspoiled(rgba: np.ndarray, _case: upright.Case, _rng: np.random.Generator) -> np.ndarray:
    return rgba


def with_thing(rgba: np.ndarray, rng: np.random.Generator, row: float, thing: Callable) -> np.ndarray:
    """A striped thing beside the figure, at a share `row` of its height from its top."""
    mask, (rows, columns) = rgba[..., 3], np.mgrid[: rgba.shape[0], : rgba.shape[1]]
    top, height = extent(mask)
    edges, right = np.flatnonzero(mask[int(top + height * row)] > 127), bool(rng.integers(2))
    inside = thing(rows - top - height * row, (columns - edges[-1]) if right else (edges[0] - columns), height)
    inside &= mask < 128
    stripes = ((rows + columns) // 12 % 2 * 40)[..., None] + rng.integers(0, 215, 3)
    return np.where(inside[..., None], np.dstack([stripes, np.full_like(mask, 255)]), rgba).astype(np.uint8)


def with_ball(rgba: np.ndarray, _case: upright.Case, rng: np.random.Generator) -> np.ndarray:
    radius = rng.uniform(0.07, 0.13)
    return with_thing(
        rgba, rng, rng.uniform(0.4, 0.9), lambda y, x, h: y**2 + (x - 0.7 * radius * h) ** 2 < (radius * h) ** 2
    )


def with_chair(rgba: np.ndarray, _case: upright.Case, rng: np.random.Generator) -> np.ndarray:
    width = rng.uniform(0.15, 0.25)
    return with_thing(
        rgba, rng, 0.75, lambda y, x, h: (np.abs(y) < 0.24 * h) & (np.abs(x - 0.4 * width * h) < width * h / 2)
    )


def without_limb(rgba: np.ndarray, case: upright.Case, rng: np.random.Generator) -> np.ndarray:
    """The mask lacks an arm or a lower leg: pixels whose nearest vertex belongs to it."""
    limb = list(LIMBS.values())[rng.integers(len(LIMBS))]
    joints = [JOINT_NAMES.index(name) for name in limb]
    pixels = case.view.project(case.posed.vertices.numpy())[0]
    places = np.argwhere(rgba[..., 3] > 0)
    nearest = cKDTree(pixels).query(places[:, ::-1] + 0.5)[1]
    gone = np.isin(default_body().skin_weights.argmax(1).numpy()[nearest], joints)
    out = rgba.copy()
    out[tuple(places[gone].T)] = 0
    return out


def wrong_mask(rgba: np.ndarray, _case: upright.Case, rng: np.random.Generator) -> np.ndarray:
    """The mask is moved aside or down, too large, or a rectangle, in a picture with a chequered background."""
    mask, (rows, columns) = rgba[..., 3], np.mgrid[: rgba.shape[0], : rgba.shape[1]]
    height, box = extent(mask)[1], np.zeros_like(mask)
    box[ndimage.find_objects((mask > 127).astype(int))[0]] = 255
    moves = [(0, 0.06 * height), (0, -0.06 * height), (0.08 * height, 0)]
    masks = [ndimage.shift(mask, move, order=0) for move in moves]
    masks += [ndimage.maximum_filter(mask, int(0.05 * height)), box]
    chequers = rng.integers(30, 220, 3) + ((rows // 30 + columns // 40) % 2 * 25)[..., None]
    colours = np.where(mask[..., None] > 127, rgba[..., :3], chequers)
    return np.dstack([colours, masks[rng.integers(len(masks))]]).astype(np.uint8)


def half(rgba: np.ndarray, _case: upright.Case, rng: np.random.Generator) -> np.ndarray:
    """Cut off between hips and knees."""
    top, height = extent(rgba[..., 3])
    out = rgba.copy()
    out[int(top + height * rng.uniform(0.5, 0.72)) :] = 0
    return out


def extent(mask: np.ndarray) -> tuple[int, int]:
    """First row and height of the figure."""
    rows = np.flatnonzero((mask > 127).any(1))
    return int(rows[0]), int(rows[-1] + 1 - rows[0])


GOOD = "good"
LIMBS = {
    f"{side} {limb}": [f"{side}_{joint}" for joint in joints]
    for side in ("left", "right")
    for limb, joints in {"arm": ("shoulder", "elbow", "wrist", "hand"), "leg": ("knee", "ankle", "foot")}.items()
}
SPOILED: Mapping[str, Callable[[np.ndarray, upright.Case, np.random.Generator], np.ndarray]] = {
    "ball": with_ball,
    "limb": without_limb,
    "mask": wrong_mask,
    "half": half,
    "chair": with_chair,
    "behind": unspoiled,
}
"""Changes to a picture with alpha; the person in "behind" faces away."""


def photographed(case: Case, folder: Path, fault: Fault) -> Photograph:
    """Save the front view as a picture, with alpha or a mask file, and read it."""
    folder.mkdir()
    rgba = case.given.views.rgba[0].numpy()
    alpha = rgba[..., 3:] / 255
    straight = np.where(alpha > 0, np.clip(rgba[..., :3] / np.maximum(alpha, 1e-3), 0, 255), 90).astype(np.uint8)
    picture, mask = fault.picture(straight), fault.mask(rgba[..., 3])
    if fault.quality is None:
        Image.fromarray(np.concatenate([picture, mask[..., None]], -1)).save(folder / "picture.png")
        return read_photographs([folder / "picture.png"])[0]
    Image.fromarray(picture).save(folder / "picture.jpg", quality=fault.quality)
    Image.fromarray(mask).save(folder / "mask.png")
    return read_photographs([folder / "picture.jpg"], [folder / "mask.png"])[0]


def given(case: Case, photograph: Photograph, model: DiffusionModel, fault: Fault, seed: int) -> InitialPose:
    """The start from a pose file with errors and no cameras."""
    noise = (
        torch.randn(24, 3, generator=torch.Generator().manual_seed(seed)) * math.radians(fault.degrees) / math.sqrt(3)
    )
    rotation = case.given.views.pose.joint_rotation @ axis_angle_to_matrix(noise)
    turn = axis_angle_to_matrix(torch.tensor([0.0, math.radians(fault.turned), 0.0]))
    rotation = torch.cat([turn @ rotation[:1], rotation[1:]])
    pose, betas = BodyPose(rotation[None], torch.zeros(1, 3)), model.shapes.bias.clone()
    camera = framed([photograph], pose, betas, [photograph.lens()])
    return InitialPose(Posture(pose, betas, camera), POSE_FILE_PRECISION, complete=False, tilted=True, stated=[False])


def with_fault(model: DiffusionModel, case: Case, folder: Path, fault: Fault, seed: int) -> tuple[float, float]:
    """Camera error and PSNR."""
    photograph = photographed(case, folder, fault)
    start = given(case, photograph, model, fault, seed)
    posture = fit_posture_in(model, [photograph], start, lambda: None).posture
    human = reconstruct(model, person_in([photograph], posture))
    return camera_error(case, photograph, posture), psnr(human, case, aligned(case, human))


def joints(betas: Float[Tensor, "10"], pose: BodyPose) -> Float[Tensor, "24 3"]:
    return pose_body(betas, pose).joints[:, :3, 3]


def camera_error(case: Case, photograph: Photograph, posture: Posture) -> float:
    """Mean distance of joints in the picture of SIZE pixels."""
    (view,) = views_of([photograph], posture.camera)
    found, _ = view.project(joints(posture.betas, posture.pose.map(lambda values: values[0])).numpy())
    front = case.given.views
    true, _ = front.camera.map(lambda values: values[0]).project(joints(case.given.betas, front.pose))
    return float(np.linalg.norm(found - true.numpy(), axis=1).mean()) * SIZE / photograph.width


def aligned(case: Case, human: Human) -> Camera:
    """Cameras of the unseen views that see the human, in the true pose, as if it were scaled and moved to the true
    joints: x_true = scale x + shift, so R x_true + t = scale (R x + (R shift + t) / scale).
    """
    own, true = (joints(betas, case.unseen.pose) for betas in (human.betas, case.given.betas))
    centred, wanted = own - own.mean(0), true - true.mean(0)
    scale = (centred * wanted).sum() / centred.square().sum()
    shift = true.mean(0) - scale * own.mean(0)
    extrinsics = case.unseen.camera.world_to_camera
    translation = (extrinsics[..., :3] @ shift + extrinsics[..., 3]) / scale
    moved = torch.cat([extrinsics[..., :3], translation[..., None]], -1)
    return dataclasses.replace(case.unseen.camera, world_to_camera=moved)


@torch.no_grad()
def pictures(human: Human, pose: BodyPose, camera: Camera) -> Float[Tensor, "v H W 3"]:
    """The human over grey, encoded."""
    primitives, drawn = place(human, pose), []
    for number in range(len(camera.intrinsics)):
        seen = march(primitives, camera.map(lambda values, number=number: values[number]))
        drawn.append(encode_srgb((seen.rgb + (1 - seen.alpha[..., None]) * GREY).clamp(0, 1)))
    return torch.stack(drawn)


def psnr(human: Human, case: Case, camera: Camera | None = None) -> float:
    views: Views = case.unseen
    drawn = pictures(human, views.pose, views.camera if camera is None else camera)
    scores = [figure_psnr(*pair) for pair in zip(drawn, over_grey(views), views.mask > 127, strict=True)]
    return float(torch.stack(scores).mean())


def sheet_row(case: Case, photograph: Photograph, posture: Posture, human: Human, camera: Camera) -> np.ndarray:
    """The kept square of the picture, ours in it, and two unseen views beside the true ones."""
    rgba = torch.from_numpy(photograph.rgba)
    square = Views(rgba[None], posture.camera, posture.pose)
    ours = pictures(human, posture.pose.map(lambda values: values[0]), posture.camera)
    drawn, true = pictures(human, case.unseen.pose, camera), over_grey(case.unseen)
    tiles = [over_grey(square)[0], ours[0], drawn[1], true[1], drawn[3], true[3]]
    images = [Image.fromarray((255 * tile).round().to(torch.uint8).numpy()) for tile in tiles]
    return np.concatenate([np.asarray(image.resize((VIEW, VIEW), Image.Resampling.BOX)) for image in images], 1)


if __name__ == "__main__":
    run(main, spoiled=spoiled)
