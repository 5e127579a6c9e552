"""Training samples of the encoder from captures: views to encode a subject from, and views to compare with.

A sample follows from (seed, epoch, index) alone: batches do not depend on the number of workers, and training resumes
from a `Position` exactly.

Images may be packed into one array per subject, which is memory-mapped and needs no decoding:

root/packed/{id}.npy     uint8 [F, C, H, W, 4]: sRGB over black, and the mask
root/packed/{id}.json    digest of the source images; an outdated pack is ignored
"""

from __future__ import annotations

import abc
import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler, get_worker_info

from primdiffusion.body.model import BodyPose
from primdiffusion.capture.reader import Captures, Subject, Window, as_camera, full_window, resample, windowed_view
from primdiffusion.files.arrays import map_npy
from primdiffusion.files.json_files import LARGEST_BYTES, read_json
from primdiffusion.files.regular_files import FileError, read_regular
from primdiffusion.files.whole_files import replacing, write_atomically
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.records import TensorRecord

PACK_FOLDER, PACK_FORMAT, PACK_VERSION = "packed", "primdiffusion-packed-captures", 1


@dataclasses.dataclass(frozen=True)
class Packing:
    """The result of packing one subject."""

    subject: str
    found: bool
    """Whether a pack of the same images existed."""
    gigabytes: float


def pack(captures: Captures) -> Iterator[Packing]:
    """Pack all subjects that have no current pack; yields each when its array is complete.

    Raises:
        FileNotFoundError, FileError: an image is missing or damaged, or cameras differ in size.
        OSError: a file cannot be written.
    """
    for name in captures.subjects:
        subject = captures.subject(name)
        found = open_pack(subject) is not None
        if not found:
            pack_subject(subject)
        yield Packing(name, found, pack_path(subject).stat().st_size / 1e9)


def pack_subject(subject: Subject) -> None:
    """Write one subject's array. Raises as `pack` does."""
    sizes = {(view.height, view.width) for view in subject.views}
    if len(sizes) != 1:
        raise FileError(
            subject.folder, "has images of several sizes, which cannot be packed", "render it with one size"
        )
    stamp = source_stamp(subject)
    shape = (subject.frames, len(subject.views), *sizes.pop(), 4)
    whole = replacing(pack_path(subject), subject.folder.parent)
    with whole as path, path.open("wb") as file:  # a full disk kills a writer of mapped memory
        header = {"descr": "|u1", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for frame in range(shape[0]):
            for camera in range(shape[1]):
                file.write(subject.rgba(frame, camera).data)
    about = {"format": PACK_FORMAT, "version": PACK_VERSION, "source": stamp}
    write_atomically(pack_path(subject).with_suffix(".json"), json.dumps(about))


def open_pack(subject: Subject) -> UInt8[np.ndarray, "F C H W 4"] | None:
    """A subject's memory-mapped array; None if there is none or the images have changed since."""
    path = pack_path(subject)
    try:
        about = read_json(path.with_suffix(".json"))
        if about != {"format": PACK_FORMAT, "version": PACK_VERSION, "source": source_stamp(subject)}:
            return None
        array = map_npy(path)
    except (OSError, ValueError, EOFError):
        return None
    view = subject.views[0]
    wanted = (subject.frames, len(subject.views), view.height, view.width, 4)
    return array if array.dtype == np.uint8 and array.shape == wanted else None


def pack_path(subject: Subject) -> Path:
    """Path of a subject's array."""
    return subject.folder.parent / PACK_FOLDER / f"{subject.name}.npy"


def source_stamp(subject: Subject) -> str:
    """Digest that changes with the images: of the completion mark, else of all names, sizes and modification times."""
    digest = hashlib.sha256()
    mark = subject.folder / capture_layout.COMPLETE_FILE
    if mark.is_file():
        digest.update(read_regular(mark, LARGEST_BYTES))
    else:
        for path in sorted(p for kind in ("img", "mask") for p in (subject.folder / kind).rglob("*.*")):
            about = path.stat()
            name = path.relative_to(subject.folder).as_posix()
            digest.update(f"{name} {about.st_size} {about.st_mtime_ns}\n".encode())
    return digest.hexdigest()


Record = TypeVar("Record", bound=TensorRecord)


class Position(NamedTuple):
    """A place in the endless sequence of samples."""

    epoch: int = 0
    index: int = 0


FIRST = Position()


class ProcessRank(NamedTuple):
    """This process among those that train together."""

    index: int = 0
    count: int = 1


SINGLE_PROCESS = ProcessRank()


@dataclasses.dataclass(frozen=True)
class SampleSettings:
    """Settings of training samples."""

    conditioning: int = 4
    """Views to encode the subject from."""
    targets: int = 4
    """Views to compare with, distinct from the conditioning views if there are enough cameras."""
    size: int = 512
    """Width and height of the images, pixels."""
    framing: Literal["whole", "crop"] = "whole"
    """whole: entire images; crop: targets are random squares around the subject, at least `size` pixels wide."""
    conditioning_frame: Literal["first", "same", "any"] = "first"
    """Frame of the conditioning views: the first (near the T pose), that of the targets, or a random one."""

    def __post_init__(self) -> None:
        """Raise ValueError if a count is not positive."""
        for name in ("conditioning", "targets", "size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} of the samples is {getattr(self, name)}: give 1 or more")


@dataclasses.dataclass(frozen=True)
class Views(TensorRecord):
    """Images of one subject in one pose, or a batch."""

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


@dataclasses.dataclass(frozen=True)
class TrainingSample(TensorRecord):
    """Input and target views of one subject, or a batch."""

    conditioning: Views
    target: Views
    betas: Float32[Tensor, "*b B"]
    subject: Int64[Tensor, "*b"]
    """Index into the dataset's `captures.subjects`."""
    frame: Int64[Tensor, "*b"]
    """Frame of the targets."""


class SampleSet(Dataset[Record], abc.ABC):
    """Samples indexed by `Position`; `len` is the number per epoch."""

    @abc.abstractmethod
    def __len__(self) -> int:
        """Samples per epoch."""


class CaptureDataset(SampleSet[TrainingSample]):
    """Samples indexed by `Position`; an epoch shows every pose of every subject once."""

    def __init__(self, captures: Captures, settings: SampleSettings | None = None, seed: int = 0) -> None:
        """Raises as `Captures.subject` if frames must be counted, in datasets without dataset.json."""
        self.captures, self.settings, self.seed = captures, settings or SampleSettings(), seed
        frames = captures.about.get("frames")
        counts = [frames or captures.subject(name).frames for name in captures.subjects]
        self._pairs = np.array([(s, f) for s, count in enumerate(counts) for f in range(count)], np.int64)
        self._packs: dict[str, np.ndarray | None] = {}
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, np.int64))

    def __len__(self) -> int:
        """Samples per epoch."""
        return len(self._pairs)

    def __getitem__(self, position: tuple[int, int]) -> TrainingSample:
        """The sample at a position.

        Raises:
            FileNotFoundError, FileError: a file is missing or damaged.
        """
        epoch, index = position
        if self._order[0] != epoch:
            shuffled = np.random.default_rng((self.seed, epoch)).permutation(len(self))
            self._order = (epoch, shuffled)
        number, frame = (int(value) for value in self._pairs[self._order[1][index]])
        subject = self.captures.subject(self.captures.subjects[number])
        draws = np.random.default_rng((self.seed, epoch, index))
        given, wanted = self._choose_cameras(len(subject.views), draws)
        given_frame = {"first": 0, "same": frame, "any": int(draws.integers(subject.frames))}
        settings = self.settings
        return TrainingSample(
            conditioning=self._views(subject, given_frame[settings.conditioning_frame], given, None),
            target=self._views(subject, frame, wanted, draws if settings.framing == "crop" else None),
            betas=torch.from_numpy(subject.smpl.betas),
            subject=torch.tensor(number),
            frame=torch.tensor(frame),
        )

    def _choose_cameras(self, count: int, draws: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        given, wanted = self.settings.conditioning, self.settings.targets
        order = draws.permutation(count)
        return np.resize(order, given), np.resize(np.roll(order, -given), wanted)

    def _views(self, subject: Subject, frame: int, cameras: np.ndarray, crops: np.random.Generator | None) -> Views:
        framed = [self._framed(subject, frame, int(camera), crops) for camera in cameras]
        camera = stack([as_camera(view) for _, view in framed])
        return Views(torch.from_numpy(np.stack([rgba for rgba, _ in framed])), camera, subject.smpl.pose(frame))

    def _framed(
        self, subject: Subject, frame: int, camera: int, crops: np.random.Generator | None
    ) -> tuple[np.ndarray, View]:
        rgba, view, size = self._rgba(subject, frame, camera), subject.views[camera], self.settings.size
        window = full_window(view) if crops is None else _crop_around_subject(rgba, size, crops)
        return resample(rgba, window, size), windowed_view(view, window, size)

    def _rgba(self, subject: Subject, frame: int, camera: int) -> np.ndarray:
        if subject.name not in self._packs:
            self._packs[subject.name] = open_pack(subject)
        packed = self._packs[subject.name]
        if packed is not None:
            return np.asarray(packed[frame, camera])
        return subject.rgba(frame, camera)

    def __getstate__(self) -> dict[str, object]:
        """Worker processes open the packs themselves."""
        return {**self.__dict__, "_packs": {}}


class _Order(Sampler[Position]):
    """Positions from `start` on, endlessly: of every `share.count` runs of `size`, the `share.index`-th."""

    def __init__(self, length: int, start: Position, size: int, share: ProcessRank) -> None:
        self._length, self._start, self._size, self._share = length, start, size, share

    def __iter__(self) -> Iterator[Position]:
        position = _after(self._start, self._share.index * self._size, self._length)
        while True:
            for _ in range(self._size):
                yield position
                position = _after(position, 1, self._length)
            position = _after(position, (self._share.count - 1) * self._size, self._length)


def batches(
    dataset: SampleSet[Record],
    size: int,
    start: Position = FIRST,
    workers: int = 0,
    share: ProcessRank = SINGLE_PROCESS,
) -> Iterator[tuple[Record, Position]]:
    """Endless batches, each with the position after it, which resumes training when passed as `start`.

    Each of several processes gets its own batches, and positions after the batches of all. The dataset is a
    `CaptureDataset`, or one that derives other records from its samples.

    Raises:
        ValueError: the batch size is not positive.
        FileNotFoundError, FileError: a file is missing or damaged.
    """
    if size < 1:
        raise ValueError(f"the batch size is {size}: give 1 or more")
    loader = DataLoader(
        dataset,
        batch_size=size,
        sampler=_Order(len(dataset), Position(*start), size, share),
        num_workers=workers,
        collate_fn=stack,
        pin_memory=torch.cuda.is_available(),
        generator=torch.Generator(),  # worker seeds must not come from the generator that training uses
    )
    position = Position(*start)
    for batch in loader:
        position = _after(position, size * share.count, len(dataset))
        yield batch, position


def stack(records: Sequence[Record]) -> Record:
    """Stack records of one type along a new first dimension; fields that are no tensors come from the first."""
    first = records[0]
    stacked = {}
    for field in dataclasses.fields(first):
        values = [getattr(record, field.name) for record in records]
        if isinstance(values[0], Tensor):
            stacked[field.name] = _stacked(values)
        elif isinstance(values[0], TensorRecord):
            stacked[field.name] = stack(values)
    return dataclasses.replace(first, **stacked)


def _stacked(values: Sequence[Tensor]) -> Tensor:
    """Stack; in a worker, directly into shared memory, which saves a copy."""
    if get_worker_info() is None:
        return torch.stack(list(values))
    shape = (len(values), *values[0].shape)
    shared = values[0].untyped_storage()._new_shared(math.prod(shape) * values[0].element_size())
    out = values[0].new_empty(0).set_(shared, 0, torch.Size(shape))  # type: ignore[call-overload]
    return torch.stack(list(values), out=out)


def _after(position: Position, samples: int, length: int) -> Position:
    total = position.index + samples
    return Position(position.epoch + total // length, total % length)


def _crop_around_subject(rgba: np.ndarray, size: int, draws: np.random.Generator) -> Window:
    """A random square inside the image, centred in the subject's bounding box as far as the image allows."""
    height, width = rgba.shape[:2]
    largest = min(width, height)
    side = float(draws.uniform(min(size, largest), largest))
    rows, columns = rgba[..., 3].any(1).nonzero()[0], rgba[..., 3].any(0).nonzero()[0]
    edges = []
    for covered, length in ((columns, width), (rows, height)):
        low, high = (covered[0], covered[-1] + 1) if len(covered) else (0, length)
        middle = draws.uniform(low, high)
        edges.append(float(np.clip(middle - side / 2, 0, length - side)))
    return Window(edges[0], edges[1], side, side)
