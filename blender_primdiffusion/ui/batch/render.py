"""`blender -c primdiffusion render`: pictures of .blend files and of humans, without a window.

OUT/pictures.json, report.json
OUT/NAME.png                    one picture
OUT/NAME/0001.png ...           several frames; turn_00.png ... of a turntable
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy

from ...backend.requests import Backend
from ...console import Report, Stop, Stopped
from ...engine import studio
from ...engine.engine import ENGINE
from ...formats.picture_files import is_whole_picture
from ...formats.regular_files import check_regular, real_path
from ...formats.whole_files import replacing
from ...jobs.deferred_volumes import deferred_volumes
from ...jobs.export import opened
from ...scene.cycles import fit_cycles_to_volumes, new_camera
from ...scene.human import humans
from ...scene.payload import PERSON_FILE, forget_session_files
from .arguments import ENGINES, motion_name, parse_render
from .people import (
    Movement,
    build_person,
    go_round,
    look_from,
    movement_of,
    moving_extent,
    new_file,
)
from .running import (
    Clock,
    Say,
    ask,
    attempt,
    backend_of,
    begun,
    check_backend,
    python_for_engine,
    run,
)

PERSON_ENDINGS = (".human.safetensors", ".human")


@dataclasses.dataclass(frozen=True)
class RenderSource:
    """A .blend or a human's file."""

    name: str
    """Name of the pictures."""
    path: Path

    @property
    def is_blend(self) -> bool:
        """Whether it is a .blend; else a human's file."""
        return self.path.suffix == ".blend"


def sources(path: Path) -> list[RenderSource]:
    """All human files that `path` names, sorted by name. Raises ValueError if there are none."""
    path = real_path(path)
    if path.is_dir():
        found = sorted(_in_folder(path), key=lambda source: source.name)
        if not found:
            raise ValueError(f"{path} contains no humans: name a folder that `generate` wrote, or of .human files")
        return found
    if path.suffix == ".blend":
        return [RenderSource(path.stem, path)]
    if path.name.endswith(PERSON_ENDINGS):
        return [RenderSource(path.parent.name if path.name == PERSON_FILE else _stem(path), path)]
    raise ValueError(f"{path} is neither a .blend nor a human (.human, .human.safetensors): name one of these")


def _in_folder(folder: Path) -> Iterator[RenderSource]:
    if (folder / PERSON_FILE).is_file():
        yield RenderSource(folder.name, folder / PERSON_FILE)
        return
    for path in folder.iterdir():
        if path.name.startswith("."):
            continue
        if (path / PERSON_FILE).is_file():
            yield RenderSource(path.name, path / PERSON_FILE)
        elif path.is_file() and path.name.endswith(PERSON_ENDINGS):
            yield RenderSource(_stem(path), path)


def _stem(path: Path) -> str:
    ending = next(ending for ending in PERSON_ENDINGS if path.name.endswith(ending))
    return path.name.removesuffix(ending)


SETTINGS = "pictures.json"
"""The settings of a folder's pictures."""
_PICTURE = (512, 512)
_SAMPLES = 4


def main(argv: Sequence[str]) -> int:
    """The command with its words; returns the exit code."""
    return run("render", argv, parse_render, _render)


@dataclasses.dataclass(frozen=True)
class _Shot:
    """A picture to draw."""

    path: Path
    frame: int
    yaw: float | None
    """Degrees; None: as the camera stands."""


def _render(options: argparse.Namespace, say: Say, stop: Stop) -> Report:
    movement, found = movement_of(options), sources(options.source)
    names = ("engine", "size", "frames", "yaw", "turntable", "transparent", "samples")
    drawn = {name: getattr(options, name) for name in names}
    report, clock = Report(), Clock(len(found))
    settings = {**drawn, "motion": motion_name(options)}
    with (
        begun(report, options.out / SETTINGS, settings, options.resume),
        contextlib.closing(studio),
        python_for_engine(options.python),
        backend_of(options.python) as backend,
    ):
        drawing = _Drawing(options, movement, backend, stop, say)
        for source in found:
            attempt(source.name, "render", lambda source=source: drawing.draw(source) > 0, report, clock, stop, say)
    return report


class _Drawing:
    """Renders sources one after the other."""

    def __init__(
        self,
        options: argparse.Namespace,
        movement: Movement | None,
        backend: Backend,
        stop: Stop,
        say: Say,
    ):
        self.say = say
        self._options, self._movement, self._backend, self._stop = options, movement, backend, stop
        self._checked = False

    def draw(self, source: RenderSource) -> int:
        if source.is_blend:
            check_regular(source.path)  # Blender would wait for a pipe
            bpy.ops.wm.open_mainfile(filepath=str(source.path), load_ui=False, use_scripts=False)
            self._prepare_blend()
        elif all(shot.path.is_file() for shot in self._shots(source.name, 1, self._last_frame())):
            return 0
        else:
            self._build(source)
        scene = bpy.context.scene
        first, last = (scene.frame_current,) * 2 if source.is_blend and not self._movement else (1, self._last_frame())
        shots = [shot for shot in self._shots(source.name, first, last) if not shot.path.is_file()]
        if shots:
            self._prepare(scene)
            extent = None if all(shot.yaw is None for shot in shots) else moving_extent(scene)
        for number, shot in enumerate(shots):
            if self._stop.is_set():
                raise Stopped
            scene.frame_set(shot.frame)
            if extent is not None and shot.yaw is not None:
                (go_round if self._options.turntable else look_from)(scene, shot.yaw, extent)
            draw(scene, shot.path, self._options.out)
            if len(shots) > 1:
                self.say(f"{source.name}: picture {number + 1} of {len(shots)}")
        if not source.is_blend:
            new_file()
            forget_session_files()
        return len(shots)

    def _last_frame(self) -> int:
        return len(self._movement.motion) if self._movement and not self._movement.still else 1

    def _shots(self, name: str, first: int, last: int) -> Iterator[_Shot]:
        options, out = self._options, self._options.out
        first, last = options.frames or (first, last)
        if options.turntable:
            for turn in range(options.turntable):
                yaw = (options.yaw or 0.0) + 360.0 * turn / options.turntable
                yield _Shot(out / name / f"turn_{turn:02d}.png", first, yaw)
        elif first == last:
            yield _Shot(out / f"{name}.png", first, options.yaw)
        else:
            for frame in range(first, last + 1):
                yield _Shot(out / name / f"{frame:04d}.png", frame, options.yaw)

    def _prepare_blend(self) -> None:
        scene = bpy.context.scene
        if self._movement is not None:
            for person in humans(scene):
                self._movement.apply(bpy.context, person)
        if self._options.yaw is not None or self._options.turntable or scene.camera is None:
            scene.camera = new_camera(scene)
            look_from(scene, self._options.yaw or 0.0, moving_extent(scene))

    def _build(self, source: RenderSource) -> None:
        """The human of a file, in an empty .blend; the volumes lie in a temporary folder."""
        new_file()
        forget_session_files()
        with tempfile.TemporaryDirectory(dir=bpy.app.tempdir or None) as folder:
            asked = {"person": str(source.path), "out_dir": folder, "size": 16}
            made = opened(source.path, Path(folder)) or ask(self._backend, "open_human", asked, self._stop)
            build_person(bpy.context, made.person, source.name, self._movement)
        render = bpy.context.scene.render
        render.resolution_x, render.resolution_y = self._options.size or _PICTURE
        look_from(bpy.context.scene, self._options.yaw or 0.0, moving_extent(bpy.context.scene))

    def _prepare(self, scene: bpy.types.Scene) -> None:
        """Engine, size and film as asked for."""
        options, render = self._options, scene.render
        if options.engine:
            render.engine = ENGINES[options.engine]
        if options.size:
            render.resolution_x, render.resolution_y = options.size
            render.resolution_percentage = 100
        render.film_transparent = options.transparent or (options.source.suffix == ".blend" and render.film_transparent)
        if render.engine == "CYCLES":
            if options.engine or options.samples:
                fit_cycles_to_volumes(scene, options.samples or _SAMPLES)
            _check_volumes()
        elif render.engine == ENGINE and not self._checked:
            check_backend(options.python)
            self._checked = True
        render.image_settings.media_type = "IMAGE"
        render.image_settings.file_format = "PNG"
        render.image_settings.color_mode = "RGBA" if render.film_transparent else "RGB"


def _check_volumes() -> None:
    """Raises OSError where volumes could not be written."""
    deferred_volumes.finish()
    if deferred_volumes.error:
        raise OSError(deferred_volumes.error)


def draw(scene: bpy.types.Scene, path: Path, folder: Path) -> None:
    """Render the scene to a PNG in `folder`, out of which no link may lead.

    Raises OSError, and RuntimeError where Blender cannot render.
    """
    bpy.ops.render.render()
    result = next(image for image in bpy.data.images if image.type == "RENDER_RESULT")
    with replacing(path, folder) as unfinished:
        result.save_render(str(unfinished), scene=scene)  # in render.filepath, Blender 5 takes {braces} for templates
        if not is_whole_picture(unfinished):  # on a full disk Blender saves what fits, and says nothing
            raise OSError(f"{path} was not written: is the disk full?")
