"""Read captures: our layout (`formats/capture_layout.py`) and the released code's (SPEC 5), which is a subset of it."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from PIL import Image
from torch import Tensor

from primdiffusion.body.model import BodyModel, BodyPose, J, default_body
from primdiffusion.capture.people_files import SUBJECT_NAME
from primdiffusion.files.arrays import all_finite, read_numbers, read_pickled_bytes
from primdiffusion.files.json_files import read_json
from primdiffusion.files.regular_files import FileError, as_file_error
from primdiffusion.files.smpl_pickle import array_of_objects, as_array, load_restricted
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.capture_layout import SMPL_FILE, SMPL_FOLDER, SMPL_PLAIN_FILE
from primdiffusion.formats.poses.motion import check_motion_size
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.pictures import (
    decoded,
    is_indexed,
    label_values,
    opened_picture,
)
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.raster.textures import BYTE_OF_LINEAR, LINEAR_OF_BYTE

KEYS = ("global_orient", "body_pose", "betas", "transl")


@dataclasses.dataclass(frozen=True, eq=False)
class SmplParameters:
    """Shape and poses of a subject."""

    theta: Float32[np.ndarray, "F n"]
    """72 axis-angle values per frame, pelvis first."""
    translation: Float32[np.ndarray, "F 3"]
    """Metres."""
    betas: Float32[np.ndarray, "B"]

    def pose(self, frame: int) -> BodyPose:
        """The pose in a frame."""
        return BodyPose.from_axis_angle(torch.from_numpy(self.theta[frame]), torch.from_numpy(self.translation[frame]))


def read_smpl(subject: Path) -> SmplParameters:
    """Read the parameters in a subject's folder.

    Raises:
        FileNotFoundError: neither file exists.
        FileError: the file is damaged or has other contents, or its pickle contains more than arrays.
    """
    plain, pickled = subject / SMPL_FOLDER / SMPL_PLAIN_FILE, subject / SMPL_FOLDER / SMPL_FILE
    if plain.is_file():
        return _checked(plain, read_numbers(plain, KEYS))
    if pickled.is_file():
        return _checked(pickled, _read_pickled(pickled))
    raise FileNotFoundError(f"{plain.parent} has neither {plain.name} nor {pickled.name}: render the subject again")


def _read_pickled(path: Path) -> dict[str, np.ndarray]:
    """Read the dictionary from a 0-d object array, without executing code from it."""
    pickled = read_pickled_bytes(path, "smpl")
    with as_file_error(path, "contains no dictionary of SMPL parameters", "download it again"):
        (content,) = array_of_objects(load_restricted(pickled, path))
        if not isinstance(content, dict):
            raise ValueError(f"it contains a {type(content).__name__}")
        if missing := [key for key in KEYS if key not in content]:
            raise FileError(path, f"lacks {missing[0]!r}", "render the subject again, or download the file again")
        return {key: as_array(content[key]) for key in KEYS}


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> SmplParameters:
    check_motion_size(path, max(values.size for values in arrays.values()))
    frames = next(iter(arrays["global_orient"].shape), 0)
    shapes = {"global_orient": (frames, 3), "body_pose": (frames, 3 * (J - 1)), "transl": (frames, 3)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise FileError(path, f"has {name} of shape {arrays[name].shape}, not {shape}", "render the subject again")
    betas = arrays["betas"].reshape(-1)
    if not all(map(all_finite, arrays.values())) or not frames or arrays["betas"].ndim > 2:
        raise FileError(path, "has no frames, or NaN or infinite values", "render the subject again")
    return SmplParameters(
        theta=np.concatenate([arrays["global_orient"], arrays["body_pose"]], axis=1).astype(np.float32),
        translation=arrays["transl"].astype(np.float32),
        betas=betas.astype(np.float32),
    )


@dataclasses.dataclass(frozen=True)
class Window:
    """A rectangle in an image, in pixels from the upper left corner."""

    left: float
    top: float
    width: float
    height: float


def full_window(view: View) -> Window:
    """The window that contains the whole image."""
    return Window(0, 0, view.width, view.height)


def windowed_view(view: View, window: Window, size: int) -> View:
    """The camera whose image of `size` x `size` pixels shows the window."""
    change = np.array(
        [
            [size / window.width, 0, -window.left * size / window.width],
            [0, size / window.height, -window.top * size / window.height],
            [0, 0, 1],
        ]
    )
    return dataclasses.replace(view, intrinsics=change @ view.intrinsics, width=size, height=size)


def resample(rgba: UInt8[np.ndarray, "H W 4"], window: Window, size: int) -> UInt8[np.ndarray, "size size 4"]:
    """Resample the window to `size` x `size` pixels with a box filter in linear light.

    Colours are premultiplied over black; outside the image everything is 0.
    """
    if window == Window(0, 0, size, size) and rgba.shape[:2] == (size, size):
        return rgba
    out = np.empty((size, size, 4), np.uint8)
    _resample(rgba, window.left, window.top, window.width / size, window.height / size, LINEAR_OF_BYTE,
              BYTE_OF_LINEAR, out)  # fmt: skip
    return out


@numba.njit(cache=True, nogil=True)
def _resample(rgba, left, top, across, down, linear_of_byte, byte_of_linear, out):
    height, width = rgba.shape[:2]
    scale = np.float32(1 / (across * down))
    for row in range(out.shape[0]):
        y0, y1 = top + row * down, top + (row + 1) * down
        for column in range(out.shape[1]):
            x0, x1 = left + column * across, left + (column + 1) * across
            red, green, blue, alpha = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for y in range(max(int(np.floor(y0)), 0), min(int(np.ceil(y1)), height)):
                share_y = min(y1, y + 1.0) - max(y0, float(y))
                for x in range(max(int(np.floor(x0)), 0), min(int(np.ceil(x1)), width)):
                    share = np.float32(share_y * (min(x1, x + 1.0) - max(x0, float(x))))
                    red += share * linear_of_byte[rgba[y, x, 0]]
                    green += share * linear_of_byte[rgba[y, x, 1]]
                    blue += share * linear_of_byte[rgba[y, x, 2]]
                    alpha += share * np.float32(rgba[y, x, 3])
            top_value = np.float32(65535)
            out[row, column, 0] = byte_of_linear[int(min(red * scale, np.float32(1)) * top_value + np.float32(0.5))]
            out[row, column, 1] = byte_of_linear[int(min(green * scale, np.float32(1)) * top_value + np.float32(0.5))]
            out[row, column, 2] = byte_of_linear[int(min(blue * scale, np.float32(1)) * top_value + np.float32(0.5))]
            out[row, column, 3] = int(min(alpha * scale, np.float32(255)) + np.float32(0.5))


CAMERAS_FILE = "cameras.json"
PASSES_OF_RELEASED = ("img", "mask")
FAINTEST = 32
"""Share of 255 below which a mask's values are labels: no view of a person is covered that little."""


@dataclasses.dataclass(frozen=True)
class Views(TensorRecord):
    """Images of one subject in one pose with their cameras, or a batch; one image has no dimension v."""

    rgba: UInt8[Tensor, "*b v H W 4"]
    """sRGB-encoded over black, and the mask; one tensor, because workers send it by copying."""
    camera: Camera
    """A batch of views [*b, v]."""
    pose: BodyPose
    """[*b]."""

    @property
    def image(self) -> UInt8[Tensor, "*b v H W 3"]:
        """sRGB-encoded, over black."""
        return self.rgba[..., :3]

    @property
    def mask(self) -> UInt8[Tensor, "*b v H W"]:
        """Coverage of the pixel by the subject, of 255."""
        return self.rgba[..., 3]


@dataclasses.dataclass(frozen=True, eq=False)
class Subject:
    """The captures of one subject."""

    folder: Path
    views: tuple[View, ...]
    smpl: SmplParameters

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name

    @property
    def frames(self) -> int:
        """Number of poses."""
        return len(self.smpl.theta)

    def camera(self, camera: int) -> Camera:
        """A camera, float32."""
        return as_camera(self.views[camera])

    def picture(self, kind: str, frame: int, camera: int) -> np.ndarray:
        """The stored values of an image file. Raises as `pictures`."""
        return self.pictures((kind,), frame, camera)[kind]

    def pictures(self, kinds: Sequence[str], frame: int, camera: int) -> dict[str, np.ndarray]:
        """The stored values of image files of one view.

        Raises:
            FileNotFoundError: a file is missing.
            FileError: one is damaged, or its size is not the camera's.
        """
        view = self.views[camera]
        paths = {kind: capture_layout.picture_path(self.folder, kind, camera, frame) for kind in kinds}
        return {kind: _read(path, kind, view.width, view.height) for kind, path in paths.items()}

    def rgba(self, frame: int, camera: int) -> UInt8[np.ndarray, "H W 4"]:
        """Colour and mask of a view. Raises as `pictures`."""
        found = self.pictures(("img", "mask"), frame, camera)
        return np.concatenate([found["img"], found["mask"][..., None]], axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Captures:
    """A dataset on disk. Subjects are read on first use and cached."""

    root: Path
    subjects: tuple[str, ...]
    """Names, sorted."""
    about: Mapping[str, Any]
    """Content of dataset.json; empty for the released layout, which has none."""
    _read: dict[str, Subject] = dataclasses.field(default_factory=dict, repr=False)

    @property
    def passes(self) -> tuple[str, ...]:
        """Passes that every view has."""
        return tuple(dict.fromkeys(self.about.get("passes", PASSES_OF_RELEASED)))

    def subject(self, name: str) -> Subject:
        """Read a subject.

        Raises:
            KeyError: there is no subject of this name.
            FileNotFoundError, FileError: a file is missing or damaged.
        """
        if name not in self.subjects:
            raise KeyError(f"{self.root} has no subject {name!r}")
        if name not in self._read:
            folder = self.root / name
            self._read[name] = Subject(folder, tuple(_read_views(folder)), read_smpl(folder))
        return self._read[name]


def open_captures(root: str | Path) -> Captures:
    """Open a dataset: the subjects in its list, or, without a list, all folders with cameras.

    Raises:
        FileNotFoundError: the folder does not exist or contains no subjects.
        FileError: its dataset.json is damaged or of another version.
        FileError: the list contains an invalid name.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"the folder of captures {root} does not exist: check the path")
    about = capture_layout.read_about(root) if (root / capture_layout.DATASET_FILE).exists() else {}
    passes = about.get("passes", [])
    if not isinstance(passes, list) or not all(isinstance(name, str) for name in passes):
        path = root / capture_layout.DATASET_FILE
        raise FileError(path, "names no passes", "render the captures again")
    listed = root / capture_layout.LIST_FILE
    if listed.is_file():
        names = sorted(set(capture_layout.read_list(root)))
    else:
        names = sorted(path.parent.name for path in root.glob(f"*/{CAMERAS_FILE}"))
    if wrong := next((name for name in names if not SUBJECT_NAME.fullmatch(name)), None):
        raise FileError(listed, f"contains {wrong!r:.80}", "subjects are named by letters, digits and . _ -")
    if not names:
        raise FileNotFoundError(f"there are no finished captures in {root}: render some, or check the path")
    return Captures(root, tuple(names), about)


def joints_of(subject: Subject, body: BodyModel | None = None) -> Float[np.ndarray, "F J 3"]:
    """World positions of the joints from joints.npz; without it (released layout), those of the body (None: default).

    Raises:
        FileError: joints.npz is damaged, or of other frames or joints.
    """
    stored = _stored_joints(subject)
    return body_joints(subject, default_body() if body is None else body) if stored is None else stored["world"]


def joints_from_body(subject: Subject, body: BodyModel) -> Float[np.ndarray, "F J 3"]:
    """World positions [F, J, 3] of a body's joints from joints.npz minus those stored of the body with its betas.

    They are zero for the body whose betas are stored, whatever rig the subject has. Raises as `joints_of`.
    """
    stored, own = _stored_joints(subject), body_joints(subject, body)
    return np.zeros_like(own) if stored is None else own - stored.get("fitted", stored["world"])


def _stored_joints(subject: Subject) -> dict[str, np.ndarray] | None:
    path = subject.folder / "joints.npz"
    try:
        stored = read_numbers(path, ("world",), optional=("fitted",))
    except FileNotFoundError:
        return None
    for joints in stored.values():
        if joints.shape != (subject.frames, J, 3):
            raise FileError(path, f"has joints of shape {joints.shape} for {subject.frames} frames", "render again")
    return stored


def body_joints(subject: Subject, body: BodyModel) -> Float[np.ndarray, "F J 3"]:
    """World positions of a body's joints in the subject's shape and poses."""
    smpl = subject.smpl
    pose = BodyPose.from_axis_angle(torch.from_numpy(smpl.theta), torch.from_numpy(smpl.translation))
    return body.shape(torch.from_numpy(smpl.betas)).pose(pose).joints[..., :3, 3].double().numpy()


def as_camera(view: View) -> Camera:
    """Convert a view to the backend's camera, float32."""
    world_to_camera = np.concatenate([view.rotation, view.translation[:, None]], axis=1)
    return Camera(
        torch.from_numpy(view.intrinsics).float(), torch.from_numpy(world_to_camera).float(), view.width, view.height
    )


def _read(path: Path, kind: str, width: int, height: int) -> np.ndarray:
    """Read an image: [H, W, 3] uint8 for img and normal, [H, W] uint8 for mask and part, uint16 for depth.

    Raises FileError for a damaged file, or one of another size.
    """
    with _named(path), opened_picture(path, bytes_each=4 if kind in ("img", "normal") else 1) as picture:
        size = picture.size
        if size == (width, height) and kind == "depth":
            if len(picture.getbands()) != 1:
                raise ValueError(f"it has {len(picture.getbands())} channels instead of one")
            return np.asarray(picture).astype(np.uint16)
        if size == (width, height) and kind == "mask":
            return _coverage(picture)
        if size == (width, height):
            return decoded(picture, "RGB" if kind in ("img", "normal") else "L")
    raise FileError(path, f"has {size[0]} x {size[1]} pixels, its camera {width} x {height}", "render it again")


def _coverage(picture: Image.Image) -> UInt8[np.ndarray, "H W"]:
    """A mask of shares of 255, or, as in the released layout, of labels: the person is what is not 0 (SPEC 5)."""
    values = label_values(picture)
    if is_indexed(picture) or int(values.max()) < FAINTEST:
        return np.where(values > 0, np.uint8(255), np.uint8(0))
    return values if values.dtype == np.uint8 else decoded(picture, "L")


@contextlib.contextmanager
def _named(path: Path, reason: str = "is not a complete image") -> Iterator[None]:
    """Errors of a file, as sentences that name it."""
    try:
        yield
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is missing: render the subject again") from None
    except (OSError, ValueError) as e:
        raise FileError(path, f"{reason} ({e!s:.160})", "render the subject again") from e


def _read_views(folder: Path) -> list[View]:
    """Read cameras.json; image sizes are not in it and come from the images."""
    path = folder / CAMERAS_FILE
    with _named(path, "cannot be read"):
        named = read_json(path)
    return capture_layout.views_in(named, path, lambda camera: _size(folder, camera))


def _size(folder: Path, camera: int) -> tuple[int, int]:
    """Width and height of a camera's images, from the header of the first."""
    for kind in ("img", "mask"):
        pictures = sorted((folder / kind / f"camera{camera:04d}").glob(f"[0-9]*{capture_layout.ENDINGS[kind]}"))
        for path in pictures[:1]:
            with _named(path), opened_picture(path, bytes_each=1) as picture:
                return picture.size
    raise FileNotFoundError(f"{folder} has no images of camera {camera}: render the subject again")
