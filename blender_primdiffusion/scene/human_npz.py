"""From the backend's human.npz to volumes on disk: read and checked, then written in slices of time."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import MOST_BODY_VALUES, ArrayFileError, all_finite, array_names, check_shapes, read_arrays
from ..formats.joints import JOINT_NAMES, PARENTS
from ..formats.json_files import parse_json
from ..formats.removing import remove_file
from ..formats.rotations import first_improper
from .body_file import body_file_name, saved_body_file
from .cycles import max_overlap
from .shape import FIELDS, OPTIONAL_FIELDS, ShapeModel, faulty_field
from .volumes import VOXELS, Grids, bake, file_name, is_readable, remove_empty, staged

FORMAT_VERSION = 2
"""The newest that is read; version 1 has no shape model."""


class HumanNpzError(ValueError):
    """A human.npz cannot be used; the message is one sentence with the remedy."""


@dataclasses.dataclass(frozen=True)
class HumanFile:
    """A generated human at rest, in the backend's axes (y up, metres); `convention` turns them into Blender's."""

    meta: dict[str, object]
    """Provenance: seed, steps, checkpoint, full_density, version."""
    betas: NDArray[np.float64]
    """Body shape [10]."""
    joints: NDArray[np.float64]
    """Rest joints [24, 3]."""
    vertices: NDArray[np.float64]
    """Shaped rest surface [V, 3]."""
    faces: NDArray[np.int64]
    """Triangles [F, 3]."""
    uv_corner: NDArray[np.float64]
    """Texture coordinates of each triangle corner [F, 3, 2], v up."""
    skin_weights: NDArray[np.float64]
    """Rows sum to one [V, 24]."""
    position: NDArray[np.float64]
    """Primitive centres [K, 3]."""
    rotation: NDArray[np.float64]
    """Local to world [K, 3, 3]; columns T, B, N."""
    half_extent: NDArray[np.float64]
    """Half sides along T, B, N [K, 3]."""
    primitive_weights: NDArray[np.float64]
    """Skinning of each primitive [K, 24]; rows sum to one."""
    rgb: NDArray[np.float32]
    """Linear colour [K, D, H, W, 3]; D along N, H along B, W along T."""
    density: NDArray[np.float32]
    """Opacity per metre [K, D, H, W], before the marcher's window."""
    shape_model: ShapeModel | None = None
    """How the human changes with the betas; None in files of format version 1."""


_SHAPES: dict[str, tuple[int | str, ...]] = {
    "betas": (10,), "joints": (24, 3), "vertices": ("V", 3), "faces": ("F", 3), "uv_corner": ("F", 3, 2),
    "skin_weights": ("V", 24), "position": ("K", 3), "rotation": ("K", 3, 3), "half_extent": ("K", 3),
    "primitive_weights": ("K", 24), "rgb": ("K", VOXELS, VOXELS, VOXELS, 3), "density": ("K", VOXELS, VOXELS, VOXELS),
}  # fmt: skip
_DTYPES: dict[str, type] = {"faces": np.int64, "rgb": np.float32, "density": np.float32}
_SAME_SURFACE = 1e-4
"""Metres the surface may be off what the shape model gives for the betas."""
_REMEDY = "generate the human again"


def read_human(path: str | Path) -> HumanFile:
    """Read and check a human.npz.

    Raises HumanNpzError when the file is missing, truncated, of another version, or holds arrays of the wrong shape,
    NaN, weights that do not sum to one, or frames that are not rotations.
    """
    path = Path(path)
    if not path.is_file():
        raise HumanNpzError(f"there is no human file at {str(path)!r}; {_REMEDY}")
    try:
        return _read(path)
    except HumanNpzError:
        raise
    except (ValueError, TypeError, OverflowError) as error:  # a text where a number belongs, or too large a number
        raise HumanNpzError(f"{path.name!r} is damaged ({error!s:.120}); {_REMEDY}") from error


def _read(path: Path) -> HumanFile:
    try:
        arrays = read_arrays(path, array_names(path), most_values=MOST_BODY_VALUES)
    except (ArrayFileError, OSError) as error:
        raise HumanNpzError(f"{path.name!r} is damaged or no human file ({error!s:.200}); {_REMEDY}") from error
    version = int(_scalar(arrays, "format_version", path))
    if not 1 <= version <= FORMAT_VERSION:
        raise HumanNpzError(
            f"{path.name!r} has format version {version!s:.20}, this add-on reads 1 to {FORMAT_VERSION}; "
            "use an add-on and a backend of the same release"
        )
    try:
        meta = parse_json(str(_scalar(arrays, "meta", path)))
    except ValueError as error:
        raise HumanNpzError(f"the field 'meta' of {path.name!r} is not JSON ({error!s:.160}); {_REMEDY}") from error
    density = meta.get("full_density", 1) if isinstance(meta, dict) else None
    if isinstance(density, bool) or not isinstance(density, int | float) or not density > 0:
        raise HumanNpzError(f"the field 'meta' of {path.name!r} holds no provenance, or no full density; {_REMEDY}")
    _check_skeleton(arrays, path)
    sizes: dict[str, int] = {}
    human = _checked_values(HumanFile(meta=meta, **_fields(arrays, path, _SHAPES, sizes)), path)
    if version == 1:
        return human
    given = {name: shape for name, shape in OPTIONAL_FIELDS.items() if name in arrays}
    model = ShapeModel.from_arrays(_fields(arrays, path, FIELDS | given, sizes))
    return dataclasses.replace(human, shape_model=_checked_shape(model, human, path))


def _scalar(arrays: dict[str, NDArray], name: str, path: Path) -> Any:
    value = _field(arrays, name, path)
    if value.size != 1:
        raise HumanNpzError(f"the field {name!r} of {path.name!r} holds {value.size} values instead of one; {_REMEDY}")
    return value.reshape(())[()]


def _field(arrays: dict[str, NDArray], name: str, path: Path) -> NDArray:
    if name not in arrays:
        raise HumanNpzError(f"{path.name!r} has no field {name!r}; {_REMEDY}")
    return arrays[name]


def _check_skeleton(arrays: dict[str, NDArray], path: Path) -> None:
    names = tuple(str(name) for name in _field(arrays, "joint_names", path).ravel())
    parents = tuple(int(parent) for parent in _field(arrays, "parents", path).ravel())
    if names != JOINT_NAMES or parents != PARENTS:
        raise HumanNpzError(f"the skeleton of {path.name!r} is not SMPL's 24 joints; choose a body in SMPL format")


def _fields(
    arrays: dict[str, NDArray], path: Path, shapes: dict[str, tuple[int | str, ...]], sizes: dict[str, int]
) -> dict[str, NDArray]:
    """The arrays of `shapes`, checked, each with its dtype."""
    fields = {name: _field(arrays, name, path) for name in shapes}
    try:
        check_shapes(path, fields, shapes, sizes)
    except ArrayFileError as error:
        raise HumanNpzError(f"{error}; {_REMEDY}") from error
    return {name: values.astype(_DTYPES.get(name, np.float64)) for name, values in fields.items()}


def _checked_values(human: HumanFile, path: Path) -> HumanFile:
    for name in _SHAPES:
        if not all_finite(getattr(human, name)):
            raise HumanNpzError(f"the field {name!r} of {path.name!r} holds NaN or infinite values; {_REMEDY}")
    faults = {
        "faces": human.faces.min() < 0 or human.faces.max() >= len(human.vertices),
        "half_extent": human.half_extent.min() <= 0,
        "density": human.density.min() < 0,
        "rotation": first_improper(human.rotation[None]) is not None,
        "skin_weights": not _rows_are_weights(human.skin_weights),
        "primitive_weights": not _rows_are_weights(human.primitive_weights),
    }
    for name, faulty in faults.items():
        if faulty:
            raise HumanNpzError(f"the field {name!r} of {path.name!r} holds impossible values; {_REMEDY}")
    return human


def _checked_shape(model: ShapeModel, human: HumanFile, path: Path) -> ShapeModel:
    name = faulty_field(model)
    if name is None and np.abs(model.rest(human.betas).vertices - human.vertices).max() > _SAME_SURFACE:
        name = "shape_basis"
    if name is not None:
        raise HumanNpzError(f"the field {name!r} of {path.name!r} holds impossible values; {_REMEDY}")
    return model


def _rows_are_weights(weights: NDArray) -> bool:
    return bool(weights.min() >= 0 and np.abs(weights.sum(-1) - 1).max() < 1e-3)


@dataclasses.dataclass(frozen=True)
class Destination:
    """Where a human's volumes go, and which ones."""

    folder: Path
    """The human's folder."""
    which: tuple[int, ...] | None = None
    """Primitives of a human in the scene that have volumes; None for a new human, where all are written."""
    later: bool = False
    """The volumes are hidden, and written after the human stands (see `unwritten`)."""


@dataclasses.dataclass(frozen=True, eq=False)
class WrittenHuman:
    """A human whose volumes, or the file to write them from, are in their folder but not yet in the scene."""

    human: HumanFile
    grids: Grids
    provenance: str
    """JSON, for the custom property `human.MARK`."""
    folder: Path
    files: tuple[Path, ...]
    """What must be in the folder: the volumes, or the file to write them from."""
    made: tuple[Path, ...]
    """Files, of volumes and the body, that did not exist before."""
    existing: Path
    """The innermost folder that existed before."""
    names: Mapping[int, str]
    """File names of the volumes that were asked for, by primitive."""
    later: Mapping[str, Path]
    """The file to write volumes from, by its name in their folder; empty where they are written."""
    began: float
    """time.monotonic() when writing began."""

    def complete(self) -> bool:
        """Whether all files still exist."""
        return all(path.is_file() for path in self.files)

    @contextlib.contextmanager
    def entering(self, folder: Callable[[], Path]) -> Iterator[None]:
        """A block that puts the human into the scene. Removes the written files when the block fails, and when the
        human's folder, `folder()` after the block, has become another one, where `files_in` has written them again."""
        try:
            yield
        except BaseException:
            self.discard()
            raise
        if (now := folder()) != self.folder:
            self.discard(but=now.parent)  # where the body's file is

    @contextlib.contextmanager
    def files_in(self, folder: Path, which: Iterable[int], keep: Mapping[str, Path]) -> Iterator[dict[int, Path]]:
        """Paths in `folder` of the volumes `which`, by primitive.

        When the block ends well, files that are not there (they were written elsewhere, or removed since) are
        written again, and the files in `keep` copied there under the names given. Raises VolumeWriteError.
        """
        files = {k: folder / (self.names.get(k) or file_name(self.grids, k, bpy.app.version)) for k in which}
        absent = [] if self.later else [k for k, path in files.items() if not is_readable(path)]
        with staged(folder) as staging:
            for _ in staging.write(self.grids, absent):
                pass
            staging.copy({**keep, **{name: path for name, path in self.later.items() if not (folder / name).is_file()}})
            yield files

    def discard(self, but: Path | None = None) -> None:
        """Remove the files that were written, except those in the folder `but`.

        A file that the system has locked stays, and counts as unused.
        """
        for path in self.made:
            if path.parent != but:
                with contextlib.suppress(OSError):  # Windows locks files that are being read
                    remove_file(path, path.parent)
        with contextlib.suppress(OSError):
            remove_empty(self.folder, self.existing)


def write_volumes(human_npz: Path, destination: Destination) -> Generator[float, None, WrittenHuman]:
    """Bake and write the volumes, and the body's file beside their folder, in steps of some milliseconds (baking takes
    longer); yields the fraction done.

    Where the volumes may come later, a copy of `human_npz` is all that is written of them. For a human in the scene,
    volumes whose file exists are not written again. Raises HumanNpzError and VolumeWriteError; then, and when it is
    closed early, no files are left.
    """
    began, folder = time.monotonic(), destination.folder
    yield 0.0
    human = read_human(human_npz)
    yield 0.0
    grids = bake(human.density, human.rgb, human.half_extent)
    yield 0.0
    provenance = _provenance(human, grids)
    yield 0.0
    count = len(grids.density)
    which = range(count) if destination.which is None else [k for k in destination.which if k < count]
    every = file_names(grids, bpy.app.version)
    names = {k: every[k] for k in which}
    files = {k: folder / name for k, name in names.items()}
    absent = [k for k, path in files.items() if destination.which is None or not is_readable(path)]
    later = {unwritten_name(every): human_npz} if destination.later and absent else {}
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    model = human.shape_model
    body = () if model is None else (folder.parent / body_file_name(model),)
    with contextlib.ExitStack() as undone:
        staging = undone.enter_context(staged(folder))
        yield from staging.write(grids, [] if later else absent)
        staging.copy(later)
        made = tuple(path for path in (*staging.paths, *body) if not path.exists())
        if model is not None:
            undone.enter_context(saved_body_file(model, folder.parent))
    needed = tuple(folder / name for name in later) or tuple(files.values())
    return WrittenHuman(human, grids, provenance, folder, needed, made, existing, names, later, began)


def file_names(grids: Grids, blender_version: tuple[int, ...]) -> list[str]:
    """Names of all volumes of a human, as this version of Blender writes them."""
    return [file_name(grids, k, blender_version) for k in range(len(grids.density))]


def unwritten_name(names: Iterable[str]) -> str:
    """The name of a file from which the volumes of these names are written."""
    return f"unwritten_{hashlib.sha256(''.join(names).encode()).hexdigest()[:12]}.npz"


def write_now(human_npz: str | Path, destination: Destination) -> WrittenHuman:
    """Run `write_volumes` to its end; raises as it does."""
    steps = write_volumes(Path(human_npz), destination)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


class VolumeWriter:
    """`write_volumes`, a slice of time at a time."""

    def __init__(self, human_npz: Path, destination: Destination) -> None:
        self.fraction = 0.0
        self.result: WrittenHuman | None = None
        """None until it is done, and where it has failed."""
        self.error: Exception | None = None
        self.over = False
        """Done, failed or stopped."""
        self._steps = write_volumes(human_npz, destination)

    def work(self, seconds: float) -> None:
        """Write for about `seconds`, one step at least."""
        end = time.monotonic() + seconds
        while not self.over:
            try:
                self.fraction = next(self._steps)
            except StopIteration as done:
                self.result, self.over = done.value, True
            except Exception as error:  # the operator tries again and reports why it fails
                self.error, self.over = error, True
            if time.monotonic() >= end:
                return

    def take(self) -> WrittenHuman | None:
        """The result, whose files are the caller's from now on; None where writing failed or files were removed.

        Finishes writing first.
        """
        self.work(float("inf"))
        written, self.result = self.result, None
        if written is not None and not written.complete():
            written.discard()
            return None
        return written

    def stop(self) -> None:
        """Stop, and leave no files."""
        self._steps.close()
        self.over = True
        if self.result is not None:
            self.result.discard()
            self.result = None


def _provenance(human: HumanFile, grids: Grids) -> str:
    offset, half = grids.drawn_box()
    centre = human.position + np.einsum("kij,kj->ki", human.rotation, offset)
    most = max_overlap(centre, human.rotation, half)
    return json.dumps({**human.meta, "betas": np.round(human.betas, 6).tolist(), "most_overlapping": most})
