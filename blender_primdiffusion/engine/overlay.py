"""Humans in the 3D views that this engine does not render, Solid above all, marched on the viewport's GPU.

Blender calls `draw` for each region that it redraws. A changed view gets a picture at once, as coarse as it must be to
be quick; a timer marches finer ones in slices when nothing has changed for a while. Nothing is marched otherwise.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterable, Iterator

import blf
import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..scene.convention import points_to_backend
from ..scene.human import BODY_MARK
from ..scene.human_file import file_version
from ..scene.proxy import PROXY_MARK
from . import studio
from .boxes import Boxes, EarlierVersionError
from .composite import NO_PLANES, PictureTextures, ViewLook, compile_shaders, draw_picture, keep_bones
from .gpu_march import GpuMarcher, GpuPayload
from .gpu_refine import GpuRefinement, MarchRequest
from .picture import PosedHuman, human_armatures, pose_of
from .solids import visible_instances
from .view import NO_SURFACE_M, PinholeView, view_from_matrices
from .viewport import camera_frame

COARSEST = 8
"""Pixels of the region per marched pixel along a side, while the view or the scene changes."""
MOST_SLICES = 2
"""Of a picture that is marched while Blender waits."""
READING_S = 0.1
"""Time for reading the files of new humans in one go."""
TICK_S = 0.02
REGIONS_KEPT = 8
WIREFRAME_OPACITY = 0.5
"""At least: without it, humans would be invisible, since they have no wires."""
_EARLIER = (
    "the human {!r} was made by an earlier version and its volumes are hidden: show these (in the Outliner, or tab "
    "Output, Volumes in Viewport), edit the human, or generate it again"
)
_UNRELATED = (
    bpy.types.Mesh,
    bpy.types.Curve,
    bpy.types.Material,
    bpy.types.NodeTree,
    bpy.types.Light,
    bpy.types.Camera,
)
_STICK_PX, _JOINT_PX = 2.2, 2.2
"""Width of Blender's sticks and radius of their joints."""


@dataclasses.dataclass(frozen=True)
class ShownHuman:
    """A human whom a 3D view shows."""

    object_uid: int
    """Of the armature, or of the object that instances it; a reference would not outlive undo."""
    pose: PosedHuman
    placed: tuple[GpuPayload, Boxes]


@dataclasses.dataclass(frozen=True)
class SceneReading:
    """What a 3D view shows besides Blender's objects."""

    humans: dict[object, ShownHuman]
    """By what their pictures depend on."""
    bones: NDArray[np.float64]
    """Ends of the bones that are shown in front [N, 2, 3], Blender's world: of armatures that are posed or edited, and
    of those that the user wants in front."""
    complete: bool
    """False where files had to be read, which took long enough: the next reading continues."""


class Overlay:
    """Pictures of all regions. All methods are for Blender's main thread, `draw` for its draw handlers."""

    def __init__(self) -> None:
        self._start: Iterator[None] | None = None
        """Compiles the shaders in steps, each of which stalls for a moment."""
        self._ready = False
        self._regions: dict[int, GpuRefinement] = {}
        """By the region's address; the latest drawn last."""
        self._readings: dict[object, SceneReading] = {}
        """By view layer and local view, since the scene has changed."""
        self._placed: dict[object, tuple[GpuPayload, Boxes]] = {}
        self.undrawn = False
        """There are pictures that the windows have not drawn."""
        self._fault = ""
        """Why the GPU cannot march."""
        self.error = ""
        """Why humans are not drawn, or not all of them."""

    def scene_changed(self, changed: Iterable[bpy.types.ID] | None = None) -> None:
        """Read the scene again for the next picture, if one of these data (None: any) may concern humans."""
        if changed is None or any(map(_concerns_humans, changed)):
            self._readings.clear()

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the humans into the region that Blender draws now."""
        marcher = self.prepare()
        if marcher is not None:
            with self._noting_faults():
                self._draw(context, marcher)

    def prepare(self) -> GpuMarcher | None:
        """The marcher; None until its shaders are compiled, which a timer does, and where the GPU cannot march.

        For draw handlers. Called before the first human stands, it saves them the wait.
        """
        marcher = self._fault or studio.gpu_marcher()
        if isinstance(marcher, str):
            self.error = f"{marcher}: show the volumes instead (tab Output, Volumes in Viewport)"
            return None
        if self._ready:
            return marcher
        self._start = self._start or self._starting(marcher)
        follow()
        return None

    @contextlib.contextmanager
    def _noting_faults(self) -> Iterator[None]:
        """After an error of the GPU nothing is marched any more."""
        try:
            yield
        except RuntimeError as error:
            self._fault, self._start = str(error), None
            self._regions.clear()

    def _draw(self, context: bpy.types.Context, marcher: GpuMarcher) -> None:
        reading = self.reading(context)
        if not reading.humans:
            return
        region, around = context.region, context.region_data
        size, step = (region.width, region.height), context.scene.primdiffusion_render.step
        window, to_view = (np.array(matrix, np.float64) for matrix in (around.window_matrix, around.view_matrix))
        placed = [human.placed for human in reading.humans.values()]
        subject = np.mean([human.pose.pelvis for human in reading.humans.values()], 0)
        view = view_from_matrices(window, to_view, _clip(window), size, subject)
        key = (tuple(reading.humans), window.tobytes(), to_view.tobytes(), size, step)
        request = MarchRequest(key, view, lambda view: marcher.march(placed, view, step))
        picture = self._picture_of(region)
        if reading.complete:
            picture.want(request)
            for _ in range(MOST_SLICES):
                if picture.shown is None or picture.shown.request.key != key:
                    picture.advance()
        if not (picture.resting and reading.complete):
            follow()
        keep_bones_in_front(context, reading.bones)
        if picture.shown is not None:
            draw_picture(picture.shown.picture, _look(context, window, to_view))

    def advance(self) -> bool:
        """Do some work that does not need the window; True when it must be drawn again."""
        news = True
        with self._noting_faults():
            news = self._advance()
        return news

    def _advance(self) -> bool:
        if self._start is not None:
            if next(self._start, self) is self:
                self._start, self._ready = None, True
            return self._ready
        news = [picture.advance() for picture in self._regions.values()]
        unread = [key for key, reading in self._readings.items() if not reading.complete]
        for key in unread:
            del self._readings[key]
        return any(news) or bool(unread)

    @property
    def resting(self) -> bool:
        """Whether every region shows its finest picture."""
        complete = all(reading.complete for reading in self._readings.values())
        at_rest = complete and all(picture.resting for picture in self._regions.values())
        return at_rest and self._start is None and not self.undrawn

    def _starting(self, marcher: GpuMarcher) -> Iterator[None]:
        payload = GpuPayload(np.zeros((1, 3, 8, 8, 8)), np.ones((1, 8, 8, 8)))
        boxes = Boxes(np.array([[0.0, 0.0, 1.0]]), np.eye(3)[None], np.full((1, 3), 0.1))
        view = PinholeView(np.diag([8.0, 8.0, 1.0]), np.eye(3, 4), (0.0, 2.0), 8, 8)
        yield
        for _ in compile_shaders():
            yield
        picture = marcher.march([(payload, boxes)] * 2, view, 0.1)
        yield
        picture.advance()
        picture.wait()

    def object_at(self, context: bpy.types.Context, x: int, y: int) -> bpy.types.Object | None:
        """The object whose human is under a pixel of the region; None where another object is in front."""
        picture, reading = self._regions.get(context.region.as_pointer()), self.reading(context)
        if picture is None or picture.shown is None or not reading.humans:
            return None
        depth = np.asarray(picture.shown.picture.depth.read(), np.float32)
        row = y * depth.shape[0] // context.region.height
        column = x * depth.shape[1] // context.region.width
        if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]) or depth[row, column] >= NO_SURFACE_M:
            return None
        point = _point(context, x, y, float(depth[row, column]))
        origin = _point(context, x, y, max(_clip(np.array(context.region_data.window_matrix))[0], -1e3))
        ray = Vector(point - origin)
        hit = context.scene.ray_cast(context.evaluated_depsgraph_get(), origin, ray.normalized(), distance=ray.length)
        if hit[0] and not context.space_data.shading.show_xray:
            return None
        nearest = min(reading.humans.values(), key=lambda human: _distance(human.placed[1], point))
        return next((obj for obj in context.view_layer.objects if obj.session_uid == nearest.object_uid), None)

    def reading(self, context: bpy.types.Context) -> SceneReading:
        """What the space shows."""
        space = context.space_data
        key = (context.view_layer.as_pointer(), space.as_pointer() if space.local_view else None)
        if key not in self._readings:
            self._readings[key] = self._read(context.evaluated_depsgraph_get(), space)
        return self._readings[key]

    def _read(self, depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D) -> SceneReading:
        humans: dict[object, ShownHuman] = {}
        candidates: list[tuple[bpy.types.Object, bpy.types.Collection, PosedHuman | Exception]] = []
        bones, drawn = [np.zeros((0, 2, 3))], set[bpy.types.Object]()
        self.error, complete, end = "", True, time.monotonic() + READING_S
        for obj, armature, matrix, owner in human_armatures(_noting(visible_instances(depsgraph, space), drawn)):
            if armature.show_in_front or armature.original.mode != "OBJECT":
                bones.append(_bones(armature, matrix))
            try:
                candidates.append((obj, owner, pose_of(armature, matrix, owner)))
            except (ValueError, OSError) as error:
                candidates.append((obj, owner, error))
        for number, (obj, owner, pose) in enumerate(candidates, 1):
            if drawn and not drawn.isdisjoint(owner.all_objects):
                continue
            try:
                if isinstance(pose, Exception):
                    raise pose
                key, known = _key(pose), studio.gpu_humans().holds(pose)
                placed = self._placed.get(key) or studio.gpu_humans().placed(pose)
            except EarlierVersionError:
                self.error = _EARLIER.format(owner.name)
                continue
            except (ValueError, OSError) as error:
                self.error = str(error)
                continue
            humans[key] = ShownHuman(obj.session_uid, pose, placed)
            if not known and number < len(candidates) and time.monotonic() > end:
                complete = False
                break
        studio.gpu_humans().keep_only(human.pose for human in humans.values())
        self._placed = {key: human.placed for key, human in humans.items()}
        return SceneReading(humans, np.concatenate(bones), complete)

    def _picture_of(self, region: bpy.types.Region) -> GpuRefinement:
        address = region.as_pointer()
        picture = self._regions.pop(address, None) or GpuRefinement(coarsest=COARSEST, samples=1)
        self._regions[address] = picture
        while len(self._regions) > REGIONS_KEPT:
            del self._regions[next(iter(self._regions))]
        return picture


overlay = Overlay()


def keep_bones_in_front(context: bpy.types.Context, bones: NDArray) -> None:
    """Let these bones [N, 2, 3], if the view shows bones, stay above the picture that is drawn next."""
    overlays, around, region = context.space_data.overlay, context.region_data, context.region
    if overlays.show_overlays and overlays.show_bones:
        to_window = np.array(around.window_matrix, np.float64) @ np.array(around.view_matrix, np.float64)
        pixel, size = context.preferences.system.pixel_size, (region.width, region.height)
        keep_bones(_in_pixels(bones, to_window, size), size, _STICK_PX * pixel, _JOINT_PX * pixel)


def draw_above_overlays(context: bpy.types.Context, picture: PictureTextures) -> None:
    """Draw a view's picture again where Blender's overlays, such as the grid, are behind a human."""
    keep_bones_in_front(context, overlay.reading(context).bones)
    draw_picture(picture, ViewLook(np.array(context.region_data.window_matrix, np.float64), again=True))


def follow() -> None:
    """March finer pictures until every region shows its finest."""
    global _steps
    if not bpy.app.timers.is_registered(_tick):
        _steps = _march_and_draw()
        bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)


def stop() -> None:
    """Stop marching finer pictures."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    overlay.undrawn = False


_steps: Iterator[float] = iter(())


def _tick() -> float | None:
    return next(_steps, None)


def _march_and_draw() -> Iterator[float]:
    """Yields seconds to wait: marching and drawing both block the windows, and between them Blender handles input."""
    while not overlay.resting:
        if overlay.advance():
            overlay.undrawn = True
            yield 0.0
            overlay.undrawn = False
            for window in bpy.context.window_manager.windows:
                for area in window.screen.areas:
                    if area.type == "VIEW_3D":
                        area.tag_redraw()
            yield 0.0
        yield TICK_S


def draw_error(context: bpy.types.Context) -> None:
    """Say in the corner of a 3D view why humans are not drawn in it."""
    if not overlay.error:
        return
    pixel = context.preferences.system.pixel_size
    blf.size(0, 12 * context.preferences.system.ui_scale)
    blf.color(0, 1.0, 0.6, 0.4, 1.0)
    blf.position(0, 20 * pixel, 20 * pixel, 0)
    blf.draw(0, f"PrimDiffusion: {overlay.error}")


def _concerns_humans(changed: bpy.types.ID) -> bool:
    """Editing a scene's other objects should not wait until all instances have been looked through."""
    if isinstance(changed, bpy.types.Object):
        return changed.type in ("ARMATURE", "EMPTY", "VOLUME") or BODY_MARK in changed or PROXY_MARK in changed
    return not isinstance(changed, _UNRELATED)


def _key(pose: PosedHuman) -> object:
    betas = None if pose.betas is None else tuple(pose.betas)
    return file_version(pose.file), pose.body, pose.object_to_world.tobytes(), pose.joints.tobytes(), betas


def _noting(
    instances: Iterable[bpy.types.DepsgraphObjectInstance], drawn: set[bpy.types.Object]
) -> Iterator[bpy.types.DepsgraphObjectInstance]:
    """The same instances; `drawn` gets objects by which Blender draws humans: volumes, mesh proxies, body meshes."""
    for instance in instances:
        obj = instance.object
        if obj.type == "VOLUME" or PROXY_MARK in obj or BODY_MARK in obj:
            drawn.add(obj.original)
        yield instance


def _bones(armature: bpy.types.Object, matrix: NDArray) -> NDArray[np.float64]:
    """Ends [N, 2, 3] of the bones that are not hidden, in Blender's world."""
    hidden = "hide" if bpy.app.version >= (5, 0) else "bone.hide"
    shown = [bone for bone in armature.pose.bones if not bone.path_resolve(hidden)]
    ends = np.array([(bone.head, bone.tail) for bone in shown], np.float64).reshape(-1, 2, 3)
    return ends @ matrix[:3, :3].T + matrix[:3, 3]


def _in_pixels(points: NDArray, matrix: NDArray, size: tuple[int, int]) -> NDArray[np.float64]:
    """Ends of bones [M, 2, 2] in pixels of the region; without those that reach behind the camera."""
    clip = np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1) @ matrix.T
    clip = clip[(clip[..., 3] > 1e-6).all(1)]
    return (clip[..., :2] / clip[..., 3:] + 1) / 2 * size


def _point(context: bpy.types.Context, x: int, y: int, depth: float) -> NDArray[np.float64]:
    """The point [3] at this depth (see `GpuMarch.depth`) under a pixel, in Blender's world."""
    around, region = context.region_data, context.region
    window, to_view = np.array(around.window_matrix, np.float64), np.array(around.view_matrix, np.float64)
    w = window[3, 2] * -depth + window[3, 3]
    ndc = np.array([2 * (x + 0.5) / region.width - 1, 2 * (y + 0.5) / region.height - 1])
    across = (ndc * w + window[:2, 2] * depth - window[:2, 3]) / np.diag(window)[:2]
    return (np.linalg.inv(to_view) @ [*across, -depth, 1.0])[:3]


def _distance(boxes: Boxes, point: NDArray) -> float:
    """Metres from a point in Blender's world to the nearest centre of a box."""
    return float(np.linalg.norm(boxes.position - points_to_backend(point), axis=1).min())


def _clip(window: NDArray) -> tuple[float, float]:
    """Start and end of what a projection shows, along the optical axis."""
    if window[3, 2] == 0:
        return (window[2, 3] + 1) / window[2, 2], (window[2, 3] - 1) / window[2, 2]
    return window[2, 3] / (window[2, 2] - 1), window[2, 3] / min(window[2, 2] + 1, -1e-9)


def _look(context: bpy.types.Context, window: NDArray, to_view: NDArray) -> ViewLook:
    around, shading = context.region_data, context.space_data.shading
    opacity, xray = 1.0, False
    if shading.type == "SOLID" and shading.show_xray:
        opacity, xray = shading.xray_alpha, True
    if shading.type == "WIREFRAME" and shading.show_xray_wireframe:
        opacity, xray = max(shading.xray_alpha_wireframe, WIREFRAME_OPACITY), True
    planes = NO_PLANES
    if around.use_clip_planes:
        planes = np.array(around.clip_planes, np.float64) @ np.linalg.inv(to_view)
    look, space = ViewLook(window, opacity, xray, planes), context.space_data
    camera = space.camera if around.view_perspective == "CAMERA" and space.overlay.show_overlays else None
    if camera is None or camera.type != "CAMERA" or not camera.data.show_passepartout:
        return look
    low, high = camera_frame(context, context.evaluated_depsgraph_get())
    size = np.array([context.region.width, context.region.height])
    return dataclasses.replace(look, frame=(*(low / size), *(high / size)), darkening=camera.data.passepartout_alpha)
