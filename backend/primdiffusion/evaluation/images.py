"""Pictures of humans in poses and views, with the joints and depth that they show: of models, meshes and folders."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL.Image import Image as PillowImage
from torch import Tensor
from torch.nn import functional

from primdiffusion.body.model import BodyPose, PosedBody, default_body
from primdiffusion.capture.coco import JOINTS
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.image import Image, decode_srgb, encode_srgb, to_bytes
from primdiffusion.geometry.pictures import opened_picture
from primdiffusion.human import VERTICAL_FOV, Human, body_of, pose_body
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import Person, make_person
from primdiffusion.primitives.anchors import attach
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.rasterise import rasterise
from primdiffusion.render.march import MarchSettings, march

HEAD = ("neck", "head")
"""SMPL's joints whose distance in the picture is the head size of PCKh."""
SIDE = 512
"""Width and height of a picture, pixels."""
MARGIN = 1.08
"""Radius of the view over that of the sphere around the body."""
WHITE_DISTANCE = 6
"""Pictures without alpha: a pixel whose channels are all within this of white (255) is background."""
SUPERSAMPLE = 2
"""Samples along a pixel's side in renders of meshes."""
SUFFIXES, FORMATS = (".png", ".jpg", ".jpeg", ".webp"), ("PNG", "JPEG", "WEBP")


@dataclasses.dataclass(frozen=True)
class TestImage:
    """A picture of one human, and where its joints are. Of a file only colours and mask are known."""

    image: Image
    joints: Float[Tensor, "12 2"] | None = None
    """JOINTS in pixels."""
    head_size: float | None = None
    """Pixels between the joints HEAD."""

    @property
    def mask(self) -> Bool[Tensor, "h w"]:
        """Pixels of the human."""
        return torch.from_numpy(self.image.alpha >= 0.5)

    @property
    def depth(self) -> Float[Tensor, "h w"]:
        """Metres along the optical axis; inf where `mask` is false, and in pictures of files."""
        return torch.where(self.mask, torch.from_numpy(self.image.depth), torch.inf)

    @property
    def pixels(self) -> UInt8[Tensor, "h w 3"]:
        """Colours over white, as a file stores them."""
        white = self.image.rgb + (1 - self.image.alpha[..., None])
        return to_bytes(encode_srgb(torch.from_numpy(white).clamp(0, 1)))


def body_camera(vertices: Float[Tensor, "V 3"], yaw: float, side: int = SIDE) -> Camera:
    """A level camera whose view holds the sphere around the middle of the vertices; `yaw` in radians, 0: the front."""
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    radius = float((vertices - middle).norm(dim=-1).max())
    towards = vertices.new_tensor([math.sin(yaw), 0.0, math.cos(yaw)])
    distance = MARGIN * radius / math.sin(VERTICAL_FOV / 2)
    return look_at(middle + distance * towards, middle, vertical_fov=VERTICAL_FOV, width=side, height=side)


def human_images(
    human: Human, poses: BodyPose, views: int, settings: MarchSettings, device: torch.device
) -> Iterator[TestImage]:
    """A human in all poses [F] from all views, drawn by the marcher on `device`."""
    body, anchors = body_of(human)
    for frame in range(len(poses.joint_rotation)):
        posed = pose_body(human.betas, poses.map(lambda t, n=frame: t[n]), body)
        primitives = Primitives.place(attach(anchors, posed.vertices, body.faces), human.payload).to(device)
        yield from primitive_images(primitives, posed, views, settings)


def primitive_images(
    primitives: Primitives, posed: PosedBody, views: int, settings: MarchSettings
) -> Iterator[TestImage]:
    """Primitives from all views around a body, drawn by the marcher on their device."""
    for view in range(views):
        camera = body_camera(posed.vertices, 2 * math.pi * view / views)
        seen = march(primitives, camera.to(primitives.position.device), settings).to("cpu")
        depth = seen.depth / camera.secants()  # distances are along rays
        yield _with_joints(Image(seen.rgb.numpy(), seen.alpha.numpy(), depth.numpy()), posed, camera)


def mesh_images(person: Person, poses: BodyPose, yaws: Sequence[Sequence[float]], side: int) -> Iterator[TestImage]:
    """A dressed mesh in poses [F], each from its own yaws, rasterised with SUPERSAMPLE^2 samples a pixel."""
    shaped = default_body().shape(torch.from_numpy(person.betas).float())
    for frame, of_pose in enumerate(yaws):
        posed = shaped.pose(poses.map(lambda t, n=frame: t[n]))
        mesh = person.mesh.posed(posed.skinning.double().numpy())
        for yaw in of_pose:
            camera = body_camera(posed.vertices, yaw, side)
            yield _with_joints(rasterise(mesh, camera, SUPERSAMPLE), posed, camera)


def mesh_images_of_seeds(assets: Assets, seeds: Sequence[int], poses: BodyPose, views: int) -> Iterator[TestImage]:
    """Meshes of MakeHuman samples in all poses [F] from all views, evenly around them. Raises as `make_person`."""
    base = load_base_mesh()
    yaws = [[2 * math.pi * view / views for view in range(views)]] * len(poses.joint_rotation)
    for seed in seeds:
        yield from mesh_images(make_person(assets, base, seed), poses, yaws, SIDE)


def _with_joints(image: Image, posed: PosedBody, camera: Camera) -> TestImage:
    pixels, _ = camera.project(posed.joints[:, :3, 3])
    neck, head = (pixels[JOINT_NAMES.index(joint)] for joint in HEAD)
    own = pixels[[JOINT_NAMES.index(joint) for joint in JOINTS]]
    return TestImage(image, own, float((neck - head).norm()))


def folder_pictures(folder: Path) -> list[Path]:
    """The pictures of a folder by name. Raises ValueError if there is no folder, or no picture in it."""
    found = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if not found:
        raise ValueError(f"{folder} has no pictures ({', '.join(SUFFIXES)}): check the path")
    return found


def folder_images(folder: Path) -> Iterator[TestImage]:
    """The pictures of a folder, resized to 512 x 512 and composited over white; their joints and depth are unknown.

    Raises ValueError for an empty folder, and pictures that are not square or unreadable.
    """
    for path in folder_pictures(folder):
        shrunk, has_alpha = _read_picture(path)
        rgb = shrunk[..., :3]
        alpha = shrunk[..., 3] if has_alpha else (rgb * 255 < 255 - WHITE_DISTANCE).any(-1).float()
        over_black = decode_srgb(rgb) - (1 - alpha[..., None])
        yield TestImage(Image(over_black.numpy(), alpha.numpy(), np.full(alpha.shape, np.inf, np.float32)))


def _read_picture(path: Path) -> tuple[Float[Tensor, "s s 4"], bool]:
    """Colour over white and alpha, resized to SIDE; whether any of it is transparent."""
    damaged = as_file_error(path, "is not a readable picture", "write it again or remove it", OSError)
    with damaged, opened_picture(path, FORMATS) as picture:
        width, height = picture.size
        if width == height:
            return _over_white(picture)
    raise ValueError(f"{path} has {width} x {height} pixels: pad it with white to a square")


def _over_white(picture: PillowImage) -> tuple[Float[Tensor, "s s 4"], bool]:
    """Colour over white and alpha, resized to SIDE; whether any of it is transparent."""
    rgba = np.asarray(picture.convert("RGBA"))
    values = torch.from_numpy(rgba.astype(np.float32)) / 255
    values[..., :3] = values[..., :3] * values[..., 3:] + (1 - values[..., 3:])
    narrow = _resized(values, (picture.height, SIDE))
    return _resized(narrow, (SIDE, SIDE)).clamp(0, 1), int(rgba[..., 3].min()) < 255


def _resized(values: Float[Tensor, "h w c"], size: tuple[int, int]) -> Float[Tensor, "h2 w2 c"]:
    if values.shape[:2] == size:
        return values
    return functional.interpolate(values.movedim(-1, 0)[None], size, mode="bicubic", antialias=True)[0].movedim(0, -1)


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of texts."""
    lines = [f"| {' | '.join(cells)} |" for cells in (headings, *rows)]
    return "\n".join([lines[0], "|---" * len(headings) + "|", *lines[1:]])
