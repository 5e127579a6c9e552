"""A new human's picture during denoising, in the 3D views, where the human will stand."""

from __future__ import annotations

from pathlib import Path

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..engine import by_engine
from ..engine.gpu import billboard
from ..engine.gpu.billboard import corners, figure_of, share_in_view
from ..engine.gpu.overlay import overlay
from ..scene.place import next_place
from .pictures import so_far
from .queue import queue
from .views import eye
from .windows import redraw_views

_LEAST_SHARE = 0.5
"""Of the picture in view: less is a piece of an arm in front of everything, of who stands beside the camera."""


class PictureInView:
    """The panel's picture while it is of a new human. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self._version: tuple[Path, int] | None = None
        self._pixels: NDArray[np.float32] | None = None
        """Linear, premultiplied [h, w, 4], bottom row first."""
        self._texture: gpu.types.GPUTexture | None = None
        self._cursor: tuple[float, ...] | None = None
        """The scene's cursor when `_place` was found."""
        self._place: NDArray[np.float64] | None = None

    def update(self) -> bool:
        """Take the panel's picture, or none; whether it has changed, so that views must be redrawn."""
        version = so_far.version if queue.current is not None and queue.current.job.new_person else None
        if version == self._version:
            return False
        self._version, self._pixels, self._texture, self._cursor = version, None, None, None
        if version is not None:
            self._pixels = so_far.pixels()
        return True

    @property
    def shown(self) -> bool:
        """Whether there is a picture for the views."""
        return self._pixels is not None

    def drawn_in(self, context: bpy.types.Context) -> bool:
        """Whether this 3D view shows the picture: it shows humans, and the human will enter its scene."""
        scene, space, entry = context.scene, context.space_data, queue.current
        if self._pixels is None or entry is None or scene.session_uid != entry.scene_uid or space.local_view:
            return False
        return scene.primdiffusion_render.in_viewports and (space.overlay.show_overlays or not by_engine(context))

    def corners(self, context: bpy.types.Context) -> NDArray[np.float64]:
        """The picture's corners [4, 3] in this 3D view; follows the 3D cursor."""
        cursor = tuple(context.scene.cursor.location)
        if cursor != self._cursor:
            self._cursor, self._place = cursor, next_place(context, eye())
        to_view = np.array(context.region_data.view_matrix, np.float64)
        return corners(self._place, to_view, figure_of(self._pixels[..., 3]))

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the picture into the region that Blender draws now, if it belongs there and most of it is in view;
        uploads it once.

        The human's own shaders are compiled meanwhile.
        """
        if not self.drawn_in(context):
            return
        overlay.prepare()
        places = self.corners(context)
        if share_in_view(places, np.array(context.region_data.perspective_matrix, np.float64)) < _LEAST_SHARE:
            return
        self._texture = self._texture or billboard.texture_of(self._pixels)
        billboard.draw(self._texture, places)


picture_in_view = PictureInView()
"""One, as there is one queue."""
_handlers: list[object] = []


def follow_picture() -> None:
    """Show the panel's picture in the 3D views as well, or remove it there."""
    if picture_in_view.update():
        redraw_views()


def _draw() -> None:
    picture_in_view.draw(bpy.context)


def register() -> None:
    """Draw into the 3D views where Blender has a window: after humans, which hide what is behind them."""
    if not bpy.app.background:
        _handlers.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW"))


def unregister() -> None:
    """Undo `register`, and free the picture."""
    while _handlers:
        bpy.types.SpaceView3D.draw_handler_remove(_handlers.pop(), "WINDOW")
    so_far.show(None)
    picture_in_view.update()
