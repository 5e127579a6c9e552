"""The measures of the paper's Tables 1 and 2 of any pictures of humans, beside those of our own network (SPEC 7).

FID, FID_CLIP and KID of published networks need weights that the user names; without them a cell is empty and says
why. The own network's distance, PCKh and depth error are always there.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.evaluation.images import SIDE, TestImage, markdown_table
from primdiffusion.evaluation.metrics import frechet_distance, kernel_distance_of_subsets, too_few_samples
from primdiffusion.evaluation.pose_depth_network import (
    PoseDepthNetwork,
    cell_means,
    correct_joints,
    depth_error,
    detail_of,
    joint_positions,
    shrunk,
)
from primdiffusion.evaluation.pretrained_networks import ClipVision, Inception
from primdiffusion.human import Human, framing, place
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.runtime.device import best_device

BATCH = 16
SMALLEST = 8
"""Fewest pictures of each set: fewer fit no Gaussian worth comparing."""
FRAMES_TIMED = 10
KID_SEED = 2020
"""Seed of KID's subsets; torch-fidelity's."""
DETAIL_FLOOR = 0.05
"""Smallest standard deviation of fine detail among real pictures, as in `attribute_network`."""


@dataclasses.dataclass(frozen=True)
class Networks:
    """The networks that look at pictures; None where no weights file was named."""

    own: PoseDepthNetwork
    inception: Inception | None = None
    clip: ClipVision | None = None


class Cell(NamedTuple):
    """A figure of a table."""

    value: float | None
    spread: float | None = None
    """Standard deviation over KID's subsets, or over pictures."""
    reason: str | None = None
    """Why there is no value."""
    note: str | None = None
    """Warning about comparing the value with others."""


@dataclasses.dataclass(frozen=True)
class Scores:
    """Features and errors that the networks found in one set of pictures."""

    pictures: int
    features: Mapping[str, Float[Tensor, "n d"]]
    """Features by network: "inception", "clip", "own" and "detail"."""
    correct: Sequence[float]
    """Share of correct joints of each picture with known joints."""
    depth: Sequence[float]
    """Depth error of each picture with known depth."""


def look_at_pictures(
    images: Iterable[TestImage], networks: Networks, report: Callable[[int], None] = lambda done: None
) -> Scores:
    """Look at every picture once. Raises what `images` raises."""
    features: dict[str, list[Tensor]] = {"own": [], "detail": []}
    correct: list[float] = []
    depth: list[float] = []
    count = 0
    iterator = iter(images)
    while batch := list(itertools.islice(iterator, BATCH)):
        pictures = [image.pixels for image in batch]
        with torch.inference_mode():
            seen = networks.own(torch.stack([shrunk(picture) for picture in pictures]).float() / 255)
            features["own"].append(seen.features)
            details = [detail_of(picture, image.mask) for picture, image in zip(pictures, batch, strict=True)]
            features["detail"].append(torch.stack(details))
            for name, network in (("inception", networks.inception), ("clip", networks.clip)):
                if network is not None:
                    features.setdefault(name, []).append(network(torch.stack(pictures).float() / 255))
        found = joint_positions(seen.heatmaps)
        for number, image in enumerate(batch):
            if image.joints is not None and image.head_size is not None:
                right = correct_joints(found[number] * len(image.image.rgb), image.joints, image.head_size)
                correct.append(float(right.double().mean()))
            cells = cell_means(1 / image.depth, image.mask)
            error = depth_error(seen.depth[number], 1 / cells, cells > 0)
            if error is not None:
                depth.append(error)
        count += len(batch)
        report(count)
    stacked = {name: torch.cat(parts).clone() for name, parts in features.items() if parts}
    return Scores(count, stacked, correct, depth)


def check_counts(fakes: int, reals: int) -> None:
    """Raise ValueError if either set is too small to compare."""
    for what, count in (("generated", fakes), ("real", reals)):
        if count < SMALLEST:
            raise ValueError(
                f"{fakes} generated and {reals} real pictures: {SMALLEST} of each are the fewest that can be compared; "
                f"give more {what} ones"
            )


def compare_pictures(
    fake: Scores, real: Scores, kid_subsets: int = 100, kid_subset_size: int = 1000
) -> dict[str, dict[str, Cell]]:
    """The cells of the rows "generated" and "real". Raises ValueError for too few pictures, and features with NaN.

    Distances of the row "real" are between its two halves.
    """
    check_counts(fake.pictures, real.pictures)
    for name, values in itertools.chain(fake.features.items(), real.features.items()):
        if not torch.isfinite(values).all():
            raise ValueError(f"the {name} network gives NaN or infinite features: its weights are damaged")
    rows = {}
    compared = Cell(None, reason="the real pictures are what is compared with")
    for row, result, distance in zip(("generated", "real"), (fake, real), _own_distances(fake, real), strict=True):
        made = row == "generated"
        rows[row] = {
            "fid_clip": _frechet(fake, real, "clip", "--clip") if made else compared,
            "fid": _frechet(fake, real, "inception", "--inception") if made else compared,
            "kid": _kid(fake, real, kid_subsets, kid_subset_size) if made else compared,
            "fps": Cell(None, reason="pictures of a folder or of meshes have no frame rate"),
            "own_pckh": _mean(result.correct, "joints"),
            "own_depth": _mean(result.depth, "depth"),
            "own_distance": distance,
        }
    return rows


def _frechet(fake: Scores, real: Scores, name: str, option: str) -> Cell:
    if name not in fake.features:
        return Cell(None, reason=f"no weights file: name one with {option}")
    return _distance(fake.features[name], real.features[name])


def _distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> Cell:
    return Cell(frechet_distance(first, second), note=too_few_samples(len(first), len(second), first.shape[1]))


def _kid(fake: Scores, real: Scores, subsets: int, size: int) -> Cell:
    if "inception" not in fake.features:
        return Cell(None, reason="no weights file: name one with --inception")
    if min(fake.pictures, real.pictures) < size:
        return Cell(
            None,
            reason=f"subsets of {size} need as many pictures, there are {fake.pictures} generated and {real.pictures} "
            "real: raise --count or lower --kid-subset-size",
        )
    found = kernel_distance_of_subsets(fake.features["inception"], real.features["inception"], subsets, size, KID_SEED)
    return Cell(100 * found.mean, 100 * found.std)


def _mean(values: Sequence[float], truth: str) -> Cell:
    """100 times the mean over pictures with truth, and its standard deviation."""
    if not values:
        return Cell(None, reason=f"the {truth} of pictures of a folder are not known")
    found = 100 * torch.tensor(values, dtype=torch.float64)
    return Cell(float(found.mean()), float(found.std(correction=0)))


def _own_distances(fake: Scores, real: Scores) -> tuple[Cell, Cell]:
    """Frechet distances of generated pictures, and of the first half of the real ones, to the second half.

    All three sets have the same size, since the distance falls with it. Pictures of one human follow each other, so
    halves are of different humans. Learned features, and detail in units of its spread among real pictures.
    """
    mean = real.features["detail"].mean(0)
    std = real.features["detail"].std(0, correction=0).clamp_min(DETAIL_FLOOR)
    made, true = (torch.cat([one.features["own"], (one.features["detail"] - mean) / std], 1) for one in (fake, real))
    count = min(len(made), len(true) // 2)
    spread = torch.linspace(0, len(made) - 1, count).long()
    second = true[-count:]
    return _distance(made[spread], second), _distance(true[:count], second)


def frames_per_second(human: Human, settings: MarchSettings) -> Cell:
    """Frames of 512 x 512 that the marcher draws of a generated human in a second: the median, after one not timed.

    Boxes are placed once; the spread is over frames.
    """
    device = best_device()
    primitives = place(human).to(device)
    seconds = []
    for number in range(FRAMES_TIMED + 1):
        camera = framing(primitives, 360 * number / FRAMES_TIMED, SIDE, SIDE)
        start = time.perf_counter()
        march(primitives, camera, settings)
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    rates = [1 / one for one in seconds[1:]]
    return Cell(statistics.median(rates), statistics.pstdev(rates))


def resolution_of(human: Human) -> str:
    """The paper's way to state it: all boxes side by side, e.g. 256 x 256 x 8 for 32 x 32 boxes of 8^3 voxels."""
    boxes, side = human.payload.density.shape[-4], human.payload.density.shape[-1]
    across = math.isqrt(boxes) * side
    return f"{across} x {across} x {side}" if math.isqrt(boxes) ** 2 == boxes else f"{boxes} x {side}^3"


COLUMNS = {
    "fid_clip": "FID_CLIP",
    "fid": "FID",
    "kid": "KID x 100",
    "fps": "FPS",
    "own_distance": "own distance",
    "own_pckh": "own PCKh@0.5",
    "own_depth": "own depth x 100",
}
"""Columns of the paper's tables, then our own network's."""
NETWORK_SCORES = {"own_pckh": 1, "own_depth": -1}
"""Columns that score how well a network reads joints or depth from pictures; 1: higher is better, -1: lower is."""


def remarks(rows: Mapping[str, Mapping[str, Cell]]) -> list[str]:
    """Sentences on figures that do not mean what they seem to: scores that real pictures do not win, biased distances.

    Rows are those of a table, "real" among them.
    """
    found = []
    for column, sign in NETWORK_SCORES.items():
        values = {row: cells[column].value for row, cells in rows.items() if row != "floor" and column in cells}
        true = values.pop("real", None)
        if true is None:
            continue
        as_good = {row: value for row, value in values.items() if value is not None and sign * (value - true) >= 0}
        if as_good:
            named = ", ".join(f"{row} {value:.4g}" for row, value in as_good.items())
            found.append(
                f"{COLUMNS[column]} does not discriminate: real pictures have {true:.4g}, which {named} reach or pass, "
                "so a better figure does not mean better pictures."
            )
    for column, title in COLUMNS.items():
        notes = dict.fromkeys(cells[column].note for cells in rows.values() if column in cells)
        found += [f"{title}: {note}." for note in notes if note is not None]
    return found


def reference_cells(card: Mapping[str, Any]) -> dict[str, Cell]:
    """The own network's errors on renders of held-out meshes, from its card: no model can be expected to have less."""
    errors = card["errors"]
    return {"own_pckh": Cell(errors["pckh"]), "own_depth": Cell(errors["depth"])}


def table(rows: Mapping[str, Mapping[str, Cell]], choices: Mapping[str, Any]) -> str:
    """Format as Markdown: the table, every choice, `remarks`, and a sentence for each empty column of the first row."""
    texts = [[row, *(_text(cells.get(column)) for column in COLUMNS)] for row, cells in rows.items()]
    lines = [markdown_table(["pictures", *COLUMNS.values()], texts)]
    lines += ["", *(f"{name}: {_plain(value)}" for name, value in choices.items())]
    said = remarks(rows)
    lines += ["", *said] if said else []
    first = next(iter(rows.values()))
    missing = {title: first[column].reason for column, title in COLUMNS.items() if first[column].value is None}
    if missing:
        lines += ["", *(f"{name} is empty: {reason}." for name, reason in missing.items())]
    return "\n".join(lines)


def _text(cell: Cell | None) -> str:
    if cell is None or cell.value is None:
        return "-"
    return f"{cell.value:.4g}" if cell.spread is None else f"{cell.value:.4g} +- {cell.spread:.2g}"


def _plain(value: Any) -> str:
    if value is None:
        return "not used"
    return ", ".join(str(one) for one in value) if isinstance(value, list | tuple) else str(value)
