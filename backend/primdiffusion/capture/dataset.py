"""Captures as one array a subject that training maps into memory: nothing to decode, nothing read that is not used.

root/packed/{id}.npy     uint8 [F, C, H, W, 4]: sRGB over black, and the mask
root/packed/{id}.json    what it was made from; a pack of other pictures than those that are there now is not used
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
from primdiffusion.capture.reader import (
    CaptureFileError,
    Captures,
    Subject,
    Window,
    as_camera,
    resample,
    through,
    whole,
)
from primdiffusion.formats import capture_layout
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.records import TensorRecord

PACK_FOLDER, PACK_FORMAT, PACK_VERSION = "packed", "primdiffusion-packed-captures", 1


@dataclasses.dataclass(frozen=True)
class Packing:
    """How far a subject is."""

    subject: str
    kept: bool
    """Whether a pack of the same pictures was there."""
    gigabytes: float


def pack(captures: Captures) -> Iterator[Packing]:
    """Pack every subject that is not; yields each when its array is whole.

    Raises:
        FileNotFoundError, CaptureFileError: a picture is missing or damaged, or cameras differ in size.
        OSError: there is no room.
    """
    for name in captures.subjects:
        subject = captures.subject(name)
        kept = open_pack(subject) is not None
        if not kept:
            pack_subject(subject)
        yield Packing(name, kept, pack_path(subject).stat().st_size / 1e9)


def pack_subject(subject: Subject) -> None:
    """Write one subject's array. Raises what `pack` does."""
    sizes = {(view.height, view.width) for view in subject.views}
    if len(sizes) != 1:
        raise CaptureFileError(f"{subject.folder} has pictures of several sizes: these cannot be packed")
    stamp = source_stamp(subject)
    shape = (subject.frames, len(subject.views), *sizes.pop(), 4)
    with capture_layout.replacing(pack_path(subject)) as path:
        array = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
        for frame in range(shape[0]):
            for camera in range(shape[1]):
                array[frame, camera, ..., :3] = subject.picture("img", frame, camera)
                array[frame, camera, ..., 3] = subject.picture("mask", frame, camera)
        array.flush()
        del array
    with capture_layout.replacing(pack_path(subject).with_suffix(".json")) as path:
        path.write_text(json.dumps({"format": PACK_FORMAT, "version": PACK_VERSION, "source": stamp}), encoding="utf-8")


def open_pack(subject: Subject) -> UInt8[np.ndarray, "F C H W 4"] | None:
    """A subject's array, mapped; None where there is none, or one of other pictures."""
    path = pack_path(subject)
    try:
        about = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        if about != {"format": PACK_FORMAT, "version": PACK_VERSION, "source": source_stamp(subject)}:
            return None
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    view = subject.views[0]
    wanted = (subject.frames, len(subject.views), view.height, view.width, 4)
    return array if array.dtype == np.uint8 and array.shape == wanted else None


def pack_path(subject: Subject) -> Path:
    """Where a subject's array lies."""
    return subject.folder.parent / PACK_FOLDER / f"{subject.name}.npy"


def source_stamp(subject: Subject) -> str:
    """A digest that changes when pictures do: of the completion mark, or of all names, sizes and times without one."""
    digest = hashlib.sha256()
    mark = subject.folder / capture_layout.COMPLETE_FILE
    if mark.is_file():
        digest.update(mark.read_bytes())
    else:
        for path in sorted(p for kind in ("img", "mask") for p in (subject.folder / kind).rglob("*.*")):
            about = path.stat()
            digest.update(f"{path.relative_to(subject.folder)} {about.st_size} {about.st_mtime_ns}\n".encode())
    return digest.hexdigest()


Record = TypeVar("Record", bound=TensorRecord)


class Position(NamedTuple):
    """Where in the endless order of samples training is."""

    epoch: int = 0
    index: int = 0


FIRST = Position()


class Share(NamedTuple):
    """Which of the processes that train together this is."""

    index: int = 0
    of: int = 1


ALONE = Share()


@dataclasses.dataclass(frozen=True)
class SampleSettings:
    """What a sample holds."""

    conditioning: int = 4
    """Views to encode the person from."""
    targets: int = 4
    """Views to compare with; others than the conditioning ones where there are enough cameras."""
    size: int = 512
    """Pixels a side."""
    framing: Literal["whole", "crop"] = "whole"
    """whole: pictures as they are; crop: of targets random squares about the person, no smaller than `size` pixels."""
    conditioning_frame: Literal["first", "same", "any"] = "first"
    """The pose of the conditioning views: near T, that of the targets, or any."""

    def __post_init__(self) -> None:
        """Raises ValueError for samples without views or pixels."""
        for name in ("conditioning", "targets", "size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} of the samples is {getattr(self, name)}: it must be 1 or more")


@dataclasses.dataclass(frozen=True)
class Views(TensorRecord):
    """Pictures of one person in one pose, or a batch of such."""

    rgba: UInt8[Tensor, "*b v H W 4"]
    """sRGB-encoded over black, and the mask; as one, because it is copied on its way from the workers."""
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
        """Share of the pixel that the person covers, of 255."""
        return self.rgba[..., 3]


@dataclasses.dataclass(frozen=True)
class TrainingSample(TensorRecord):
    """One person: what is given, and what is to come out; or a batch of such."""

    conditioning: Views
    target: Views
    betas: Float32[Tensor, "*b B"]
    subject: Int64[Tensor, "*b"]
    """Number in the dataset's `captures.subjects`."""
    frame: Int64[Tensor, "*b"]
    """Of the targets."""


class SampleSet(Dataset[Record], abc.ABC):
    """Samples by `Position`; `len` is how many an epoch has."""

    @abc.abstractmethod
    def __len__(self) -> int:
        """Samples of an epoch."""


class CaptureDataset(SampleSet[TrainingSample]):
    """Samples by `Position`; an epoch shows every pose of everybody once."""

    def __init__(self, captures: Captures, settings: SampleSettings | None = None, seed: int = 0) -> None:
        """Raises what `Captures.subject` does where frames must be counted (datasets without dataset.json)."""
        self.captures, self.settings, self.seed = captures, settings or SampleSettings(), seed
        frames = captures.about.get("frames")
        counts = [frames or captures.subject(name).frames for name in captures.subjects]
        self._pairs = np.array([(s, f) for s, count in enumerate(counts) for f in range(count)], np.int64)
        self._packs: dict[str, np.ndarray | None] = {}
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, np.int64))

    def __len__(self) -> int:
        """Samples of an epoch."""
        return len(self._pairs)

    def __getitem__(self, position: tuple[int, int]) -> TrainingSample:
        """The sample at a position.

        Raises:
            FileNotFoundError, CaptureFileError, ArrayFileError, BodyFileError: a file is missing or damaged.
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
        size, pictures, seen = self.settings.size, [], []
        for camera in cameras:
            rgba, view = self._rgba(subject, frame, int(camera)), subject.views[camera]
            window = whole(view) if crops is None else _about_the_person(rgba, size, crops)
            pictures.append(resample(rgba, window, size))
            seen.append(through(view, window, size))
        camera = stack([as_camera(view) for view in seen])
        return Views(torch.from_numpy(np.stack(pictures)), camera, subject.smpl.pose(frame))

    def _rgba(self, subject: Subject, frame: int, camera: int) -> np.ndarray:
        if subject.name not in self._packs:
            self._packs[subject.name] = open_pack(subject)
        packed = self._packs[subject.name]
        if packed is not None:
            return np.asarray(packed[frame, camera])
        image, mask = (subject.picture(kind, frame, camera) for kind in ("img", "mask"))
        return np.concatenate([image, mask[..., None]], axis=-1)

    def __getstate__(self) -> dict[str, object]:
        """Worker processes map the packs themselves."""
        return {**self.__dict__, "_packs": {}}


class _Order(Sampler[Position]):
    """Positions from `start` on, without end: of every `share.of` runs of `size`, the `share.index`-th."""

    def __init__(self, length: int, start: Position, size: int, share: Share) -> None:
        self._length, self._start, self._size, self._share = length, start, size, share

    def __iter__(self) -> Iterator[Position]:
        position = _after(self._start, self._share.index * self._size, self._length)
        while True:
            for _ in range(self._size):
                yield position
                position = _after(position, 1, self._length)
            position = _after(position, (self._share.of - 1) * self._size, self._length)


def batches(
    dataset: SampleSet[Record], size: int, start: Position = FIRST, workers: int = 0, share: Share = ALONE
) -> Iterator[tuple[Record, Position]]:
    """Batches without end, each with the position behind it: save it, and `start` there to go on.

    Of several processes each gets its own batches, and behind them is the place where all are done. The dataset is a
    `CaptureDataset`, or one that makes other records of its samples.

    Raises:
        ValueError: the batch size is not positive.
        FileNotFoundError, CaptureFileError, ArrayFileError, BodyFileError: a file is missing or damaged.
    """
    if size < 1:
        raise ValueError(f"a batch of {size} samples: ask for one or more")
    loader = DataLoader(
        dataset,
        batch_size=size,
        sampler=_Order(len(dataset), Position(*start), size, share),
        num_workers=workers,
        collate_fn=stack,
        pin_memory=torch.cuda.is_available(),
        generator=torch.Generator(),  # the loader draws seeds for its workers: not from what training draws from
    )
    position = Position(*start)
    for batch in loader:
        position = _after(position, size * share.of, len(dataset))
        yield batch, position


def stack(records: Sequence[Record]) -> Record:
    """Records of one kind as one with a batch dimension in front; what is no tensor is the first one's."""
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
    """In a worker straight into the memory that the training process sees, which saves a copy."""
    if get_worker_info() is None:
        return torch.stack(list(values))
    shape = (len(values), *values[0].shape)
    shared = values[0].untyped_storage()._new_shared(math.prod(shape) * values[0].element_size())
    out = values[0].new_empty(0).set_(shared, 0, torch.Size(shape))  # type: ignore[call-overload]
    return torch.stack(list(values), out=out)


def _after(position: Position, samples: int, length: int) -> Position:
    total = position.index + samples
    return Position(position.epoch + total // length, total % length)


def _about_the_person(rgba: np.ndarray, size: int, draws: np.random.Generator) -> Window:
    """A random square inside of the picture whose middle is a place in the person's bounding box, as far as it can."""
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
