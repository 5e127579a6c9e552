"""Pictures of humans in poses and views, with the joints and depth that they show: of models, meshes and folders."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn import functional

from primdiffusion.body.model import BodyPose, PosedBody, default_body
from primdiffusion.formats.arrays import read_npy
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.json_files import read_json
from primdiffusion.formats.regular_files import as_file_error
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.pictures import opened_picture, strips
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import VERTICAL_FOV, Human, body_of, pose_body
from primdiffusion.people.person import Person
from primdiffusion.primitives.anchors import attach
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.march import MarchSettings, march

JOINTS = tuple(
    f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
)
"""The joints that SMPL and COCO share, in COCO's order."""
HEAD = ("neck", "head")
"""SMPL's joints whose distance in the picture is the head size of PCKh."""
SIDE = 512
"""Width and height of a picture, pixels."""
MARGIN = 1.08
"""Radius of the view over that of the sphere around the body."""
FAR_OUTSIDE = 100
"""Widths of the picture that no joint is away from its corner."""
WHITE_DISTANCE = 6
"""Pictures without alpha: a pixel whose channels are all within this of white (255) is background."""
STRIP_PIXELS = 2**17
"""Pixels that are resized at once."""
SUPERSAMPLE = 2
"""Samples along a pixel's side in renders of meshes."""
SUFFIXES, FORMATS = (".png", ".jpg", ".jpeg", ".webp"), ("PNG", "JPEG", "WEBP")
JOINTS_FILE = "joints.json"
DEPTH_FOLDER = "depth"


@dataclasses.dataclass(frozen=True)
class TestImage:
    """A picture of one human over white, and its truth where that is known."""

    name: str
    rgb: UInt8[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"]
    """Pixels of the human."""
    joints: Float[Tensor, "12 2"] | None
    """JOINTS in pixels."""
    head_size: float | None
    """Pixels between the joints HEAD."""
    depth: Float[Tensor, "h w"] | None
    """Metres along the optical axis; inf for background."""


def body_camera(vertices: Float[Tensor, "V 3"], yaw: float, side: int = SIDE) -> Camera:
    """A level camera whose view holds the sphere around the middle of the vertices; `yaw` in radians, 0: the front."""
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    radius = float((vertices - middle).norm(dim=-1).max())
    towards = vertices.new_tensor([math.sin(yaw), 0.0, math.cos(yaw)])
    distance = MARGIN * radius / math.sin(VERTICAL_FOV / 2)
    return look_at(middle + distance * towards, middle, vertical_fov=VERTICAL_FOV, width=side, height=side)


def human_images(
    human: Human, poses: BodyPose, views: int, name: str, settings: MarchSettings, device: torch.device
) -> Iterator[TestImage]:
    """A human in all poses [F] from all views, drawn by the marcher on `device`."""
    body, anchors = body_of(human)
    for number in range(len(poses.joint_rotation)):
        posed = pose_body(human.betas, poses.map(lambda t, n=number: t[n]), body)
        primitives = Primitives.place(attach(anchors, posed.vertices, body.faces), human.payload).to(device)
        yield from primitive_images(primitives, posed, views, f"{name}_{number:02d}", settings)


def primitive_images(
    primitives: Primitives, posed: PosedBody, views: int, name: str, settings: MarchSettings
) -> Iterator[TestImage]:
    """Primitives from all views around a body, drawn by the marcher on their device."""
    for view in range(views):
        camera = body_camera(posed.vertices, 2 * math.pi * view / views)
        seen = march(primitives, camera.to(primitives.position.device), settings).to("cpu")
        yield _test_image(f"{name}_{view:02d}", seen.rgb, seen.alpha, seen.depth, posed.joints, camera)


def mesh_images(
    person: Person, poses: BodyPose, yaws: Sequence[Sequence[float]], name: str, side: int
) -> Iterator[TestImage]:
    """A dressed mesh in poses [F], each from its own yaws, rasterised with SUPERSAMPLE^2 samples a pixel."""
    shaped = default_body().shape(torch.from_numpy(person.betas).float())
    for number, of_pose in enumerate(yaws):
        posed = shaped.pose(poses.map(lambda t, n=number: t[n]))
        mesh = person.mesh.posed(posed.skinning.double().numpy())
        for view, yaw in enumerate(of_pose):
            camera = body_camera(posed.vertices, yaw, side)
            seen = rasterise(mesh, camera, SUPERSAMPLE)
            rgb, alpha, depth = (torch.from_numpy(array) for array in (seen.rgb, seen.alpha, seen.depth))
            yield _test_image(f"{name}_{number:02d}_{view:02d}", rgb, alpha, depth, posed.joints, camera)


def _test_image(
    name: str,
    rgb: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    distance: Float[Tensor, "h w"],
    joints: Float[Tensor, "24 4 4"],
    camera: Camera,
) -> TestImage:
    pixels, _ = camera.project(joints[:, :3, 3])
    own = pixels[[JOINT_NAMES.index(joint) for joint in JOINTS]]
    neck, head = (pixels[JOINT_NAMES.index(joint)] for joint in HEAD)
    white = encode_srgb((rgb + (1 - alpha[..., None])).clamp(0, 1))
    mask = alpha >= 0.5
    cosine = camera.rays()[1] @ camera.world_to_camera[2, :3]  # distances are along rays
    depth = torch.where(mask, distance * cosine, torch.inf)
    return TestImage(name, (white * 255).round().to(torch.uint8), mask, own, float((neck - head).norm()), depth)


def folder_pictures(folder: Path) -> list[Path]:
    """The pictures of a folder by name. Raises ValueError if there is no folder, or no picture in it."""
    found = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if not found:
        raise ValueError(f"{folder} has no pictures ({', '.join(SUFFIXES)}): check the path")
    return found


def folder_images(folder: Path) -> Iterator[TestImage]:
    """The pictures of a folder, resized to 512 x 512 and composited over white.

    `joints.json`, if there, maps a picture's name to the pixels of SMPL's 24 joints [24, 2], and `depth/NAME.npy` is
    its depth in metres along the optical axis (inf or 0: background), of the picture's size.
    Raises ValueError for an empty folder, pictures that are not square or unreadable, and truth that does not fit.
    """
    paths = folder_pictures(folder)
    with as_file_error(folder / JOINTS_FILE, "is damaged", "write it again"):
        truth = read_json(folder / JOINTS_FILE) if (folder / JOINTS_FILE).is_file() else {}
    if not isinstance(truth, dict):
        raise ValueError(f"{folder / JOINTS_FILE} is not an object of picture names: see docs/design/evaluation.md")
    for path in paths:
        shrunk, size, has_alpha = _read_picture(path)
        rgb = shrunk[..., :3]
        mask = shrunk[..., 3] >= 0.5 if has_alpha else (rgb * 255 < 255 - WHITE_DISTANCE).any(-1)
        joints, head_size = _joints(truth.get(path.name), size, folder / JOINTS_FILE, path.name)
        depth = _depth(folder / DEPTH_FOLDER / f"{path.stem}.npy", size)
        yield TestImage(path.name, (rgb * 255).round().to(torch.uint8), mask, joints, head_size, depth)


def _read_picture(path: Path) -> tuple[Float[Tensor, "s s 4"], int, bool]:
    """Colour over white and alpha, resized to SIDE; the picture's own side; whether any of it is transparent."""
    damaged = as_file_error(path, "is not a readable picture", "write it again or remove it", OSError)
    with damaged, opened_picture(path, FORMATS) as picture:
        width, height = picture.size
        if width == height:
            shrunk, has_alpha = _over_white(picture)
            return shrunk, width, has_alpha
    raise ValueError(f"{path} has {width} x {height} pixels: pad it with white to a square")


def _over_white(picture: Image.Image) -> tuple[Float[Tensor, "s s 4"], bool]:
    """Colour over white and alpha, resized to SIDE; whether any of it is transparent.

    The bicubic filter with antialiasing is separable: strips of rows are shrunk in width, and what they give in height.
    A whole picture in float32 would take gigabytes.
    """
    narrow, has_alpha = torch.empty(picture.height, SIDE, 4), False
    for top, strip in strips(picture, STRIP_PIXELS):
        rgba = np.asarray(strip.convert("RGBA"))
        has_alpha = has_alpha or int(rgba[..., 3].min()) < 255
        values = torch.from_numpy(rgba.astype(np.float32)) / 255
        values[..., :3] = values[..., :3] * values[..., 3:] + (1 - values[..., 3:])
        narrow[top : top + len(values)] = _resized(values, (len(values), SIDE))
    return _resized(narrow, (SIDE, SIDE)).clamp(0, 1), has_alpha


def _resized(values: Float[Tensor, "h w c"], size: tuple[int, int]) -> Float[Tensor, "h2 w2 c"]:
    if values.shape[:2] == size:
        return values
    return functional.interpolate(values.movedim(-1, 0)[None], size, mode="bicubic", antialias=True)[0].movedim(0, -1)


def _nearest(values: Float[Tensor, "h w"]) -> Float[Tensor, "s s"]:
    if values.shape == (SIDE, SIDE):
        return values
    return functional.interpolate(values[None, None], (SIDE, SIDE), mode="nearest")[0, 0]


def _joints(given: Any, size: int, source: Path, name: str) -> tuple[Tensor | None, float | None]:
    if given is None:
        return None, None
    with as_file_error(source, f"has joints of {name} that are not numbers", "give 24 rows x, y"):
        pixels = torch.tensor(given, dtype=torch.float32) * (SIDE / size)
    if pixels.shape != (len(JOINT_NAMES), 2) or not torch.isfinite(pixels).all():
        raise ValueError(f"{source}: the joints of {name} have shape {tuple(pixels.shape)}: give 24 finite rows x, y")
    if pixels.abs().max() > FAR_OUTSIDE * SIDE:
        raise ValueError(f"{source}: joints of {name} are not in its picture or near it: give them in pixels")
    neck, head = (pixels[JOINT_NAMES.index(joint)] for joint in HEAD)
    return pixels[[JOINT_NAMES.index(joint) for joint in JOINTS]], float((neck - head).norm())


def _depth(path: Path, size: int) -> Float[Tensor, "s s"] | None:
    if not path.is_file():
        return None
    with as_file_error(path, "holds no depth", "write it again"):
        depth = torch.from_numpy(np.asarray(read_npy(path), np.float32))
    if depth.shape != (size, size):
        raise ValueError(f"{path} has shape {tuple(depth.shape)}, its picture {size} x {size} pixels: give one size")
    depth = torch.where(torch.isfinite(depth) & (depth > 0), depth, torch.inf)
    return _nearest(depth)
