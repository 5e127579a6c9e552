"""What is wrong in a folder of results: half-written files after a death, other contents after the next run."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file

UNFINISHED = (".partial", ".primdiffusion-partial", ".writing_", ".dataset.json.")
"""Parts of the names of files and folders that are being written."""
METRICS, STATE, LOCK = "metrics.jsonl", "state.safetensors", ".lock"
"""Of a training: its log, the end of the names of its states, and what its process locks."""
TIMED = {"run.json", "config.json", "report.json"}
"""JSON files that hold times, versions or the paths of their folder."""


def files_of(folder: Path) -> dict[str, Path]:
    """All files and links below a folder, by their relative paths."""
    return {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if not path.is_dir()}


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in files_of(folder).values())


def is_unfinished(name: str) -> bool:
    """Whether a relative path is that of a file that is being written."""
    return any(part in name for part in UNFINISHED)


def half_written(folder: Path) -> list[str]:
    """Names of published files that cannot be read to their end."""
    return [name for name, path in files_of(folder).items() if not is_unfinished(name) and not _is_whole(path)]


def leftovers(folder: Path) -> list[str]:
    """Relative paths of files and folders that are being written."""
    names = [str(path.relative_to(folder)) for path in folder.rglob("*")]
    return [name for name in names if is_unfinished(name)]


def differences(folder: Path, reference: Path) -> list[str]:
    """What differs between two finished results: names, and contents but for times, versions and paths."""
    found, expected = files_of(folder), files_of(reference)
    wrong = [f"{name} is missing" for name in expected if name not in found]
    wrong += [f"{name} was left over" for name in [*leftovers(folder), *found] if name not in expected]
    both = [name for name in expected if name in found]
    return wrong + [f"{name} differs" for name in both if not _same(found[name], expected[name])]


def finished(folder: Path, reference: Path) -> dict[str, int]:
    """How far published files are: the steps of a training's state, otherwise 1 for what is as in the reference.

    Without logs: their lines since the last state are written again.
    """
    expected, found = files_of(reference), files_of(folder)
    return {name: _far(path, expected[name]) for name, path in found.items() if name in expected and name != METRICS}


def set_back(before: Mapping[str, int], now: Mapping[str, int]) -> list[str]:
    """What is less far than before."""
    return [f"{name} was lost" for name, number in before.items() if now.get(name, 0) < number]


def _far(path: Path, other: Path) -> int:
    try:
        if path.name.endswith(STATE):
            with safe_open(path, framework="pt") as file:
                return int(file.metadata()["step"])
        return int(_same(path, other))
    except Exception:  # it is half-written, which `half_written` finds
        return 0


def _is_whole(path: Path) -> bool:
    reader = READERS.get(path.suffix)
    try:
        if reader is not None:
            reader(path)
    except Exception:
        return False
    return path.stat().st_size > 0 or path.suffix in (".txt", ".jsonl") or path.name == LOCK  # these may be empty


def _same(path: Path, other: Path) -> bool:
    if path.read_bytes() == other.read_bytes():
        return True
    if path.name in TIMED:
        return _is_whole(path)
    if path.name == METRICS:
        return _timeless(path) == _timeless(other)
    if path.suffix not in (".npz", ".safetensors"):
        return False
    read = _arrays if path.suffix == ".npz" else load_file
    one, two = read(path), read(other)
    return one.keys() == two.keys() and all(_equal(one[name], two[name]) for name in one)


def _equal(one: np.ndarray | torch.Tensor, other: np.ndarray | torch.Tensor) -> bool:
    if isinstance(one, torch.Tensor):
        return torch.equal(one, torch.as_tensor(other))
    return np.array_equal(one, other)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=True) as archive:  # the released layout has pickled dictionaries
        return dict(archive)


def _timeless(path: Path) -> list[dict]:
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [{name: value for name, value in row.items() if not name.startswith("seconds")} for row in rows]


def _picture(path: Path) -> None:
    with Image.open(path) as picture:
        picture.load()


def _lines(path: Path) -> None:
    """All lines but the last, which is dropped when a run is resumed."""
    for line in path.read_text(encoding="utf-8").splitlines()[:-1]:
        json.loads(line)


READERS: dict[str, Callable[[Path], object]] = {
    ".npz": _arrays,
    ".npy": lambda path: np.load(path, allow_pickle=True),
    ".safetensors": load_file,
    ".json": lambda path: json.loads(path.read_text(encoding="utf-8")),
    ".jsonl": _lines,
    ".png": _picture,
    ".jpg": _picture,
}
