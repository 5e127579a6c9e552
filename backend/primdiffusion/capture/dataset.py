"""Training samples of the encoder from captures: views to encode a subject from, and views to compare with.

A sample follows from (seed, epoch, index) alone: batches do not depend on the number of workers, and training resumes
from a `Position` exactly.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from primdiffusion.capture.reader import (
    Captures,
    Subject,
    Views,
    Window,
    as_camera,
    full_window,
    resample,
    windowed_view,
)
from primdiffusion.formats.camera_rig import View
from primdiffusion.formats.requests import Count
from primdiffusion.formats.schema import Checked
from primdiffusion.geometry.records import TensorRecord

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
class SampleSettings(Checked):
    """Settings of training samples."""

    views: Count = 8
    """Input images; if a subject has fewer, some are used twice."""
    targets: Count = 1
    """Target images of each subject, of other cameras than the input's if there are enough."""
    size: Count = 512
    """Width and height of the images, pixels: what is learned from smaller ones is blurred in larger ones."""
    framing: Literal["whole", "crop"] = "crop"
    """crop: targets are random squares around the subject, of `size` pixels or more; whole: whole images, as in the
    paper."""
    conditioning_frame: Literal["first", "same", "any"] = "any"
    """Frame of the input images: the first, near T (released), that of the targets, or any."""


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

    def __init__(self, captures: Captures, settings: SampleSettings, seed: int = 0) -> None:
        """Raises as `Captures.subject` if frames must be counted, in datasets without dataset.json."""
        self.captures, self.settings, self.seed = captures, settings, seed
        frames = captures.about.get("frames")
        counts = [frames or captures.subject(name).frames for name in captures.subjects]
        self._pairs = np.array([(s, f) for s, count in enumerate(counts) for f in range(count)], np.int64)
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
        given, wanted = self.settings.views, self.settings.targets
        order = draws.permutation(count)
        return np.resize(order, given), np.resize(np.roll(order, -given), wanted)

    def _views(self, subject: Subject, frame: int, cameras: np.ndarray, crops: np.random.Generator | None) -> Views:
        framed = [self._framed(subject, frame, int(camera), crops) for camera in cameras]
        camera = stack([as_camera(view) for _, view in framed])
        return Views(torch.from_numpy(np.stack([rgba for rgba, _ in framed])), camera, subject.smpl.pose(frame))

    def _framed(
        self, subject: Subject, frame: int, camera: int, crops: np.random.Generator | None
    ) -> tuple[np.ndarray, View]:
        rgba, view, size = subject.rgba(frame, camera), subject.views[camera], self.settings.size
        window = full_window(view) if crops is None else _crop_around_subject(rgba, size, crops)
        return resample(rgba, window, size), windowed_view(view, window, size)


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
    """Stack records of one type along a new first dimension; fields that are not tensors come from the first."""
    first = records[0]
    stacked = {}
    for field in dataclasses.fields(first):
        values = [getattr(record, field.name) for record in records]
        if isinstance(values[0], Tensor):
            stacked[field.name] = torch.stack(values)
        elif isinstance(values[0], TensorRecord):
            stacked[field.name] = stack(values)
    return dataclasses.replace(first, **stacked)


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
