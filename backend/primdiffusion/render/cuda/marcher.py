"""A scene prepared for many pictures on a CUDA device: packed once, and launched as graphs (SPEC 4)."""

from __future__ import annotations

import threading

import torch
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.render.cuda import scene as cuda_scene
from primdiffusion.render.cuda.scene import MarchScene, Packed, Picture, PlacedBoxes, Plan, Shapes
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import MarchSettings

MOST = 4
"""Prepared scenes that `march_cuda` keeps; image sizes of one, and plans of one size, whose launches are kept."""
GEOMETRY = cuda_scene.BOX_FIELDS[:3]


class Marcher:
    """Primitives [1 or B, K, ...] prepared for pictures: `Marcher(primitives)(camera)`, `march_cuda` without gradients.

    A new camera packs nothing, and from the second picture of a size on two graphs take the place of the launches: one
    up to the totals that the host looks at, one that draws meanwhile. Holds 9 KB per box, and for each image size 24
    bytes per pixel and the lists of tiles. One thread and one stream may use it at a time.

    Primitives that change in place are packed anew, where torch notices: not if they change through `.data`, or by
    graphs and kernels that are not torch's. Then call `show`.
    """

    def __init__(
        self,
        primitives: Primitives,
        settings: MarchSettings = MarchSettings(),  # noqa: B008
        shapes: Shapes = Shapes(),  # noqa: B008
    ) -> None:
        position = primitives.position
        self.settings, self.shapes, self.device = settings, shapes, position.device
        with torch.inference_mode(False):
            self.geometry = [torch.empty_like(getattr(primitives, name)).contiguous() for name in GEOMETRY]
            people, boxes = position.shape[:2]
            self.packed = Packed.room(people, boxes, self.device)
        self._sizes: dict[tuple, _Size] = {}
        self.show(primitives)

    @torch.no_grad()
    def show(self, primitives: Primitives) -> None:
        """Draw these from now on, of the same shapes and on the same device."""
        self.primitives = primitives
        self._versions = _versions(primitives)
        with cuda_scene.on_device(self.device):
            cuda_graph.copy_all(self.geometry, [getattr(primitives, name) for name in GEOMETRY])
            self.packed.pack(primitives.rgb.contiguous(), primitives.density.contiguous())

    @torch.no_grad()
    def __call__(self, camera: Camera) -> Rendering:
        """Draw the primitives from a camera [B, ...]. Raises ValueError as `march_cuda` does."""
        if self._versions is None or _versions(self.primitives) != self._versions:
            self.show(self.primitives)
        tensors = [camera.intrinsics, camera.world_to_camera]
        key = (camera.width, camera.height, *((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors))
        with cuda_scene.on_device(self.device):
            if key not in self._sizes:
                cuda_scene.check(self.primitives, camera, None)
                if len(self._sizes) >= MOST:
                    self._sizes.pop(next(iter(self._sizes)))
                self._sizes[key] = _Size(self, camera)
            return self._sizes[key].draw(camera)


def _versions(primitives: Primitives) -> tuple[tuple[int, int], ...] | None:
    """Versions of the tensors, which change with them in place; None in inference mode, where torch counts none."""
    tensors = list(vars(primitives).values())
    if any(tensor.is_inference() for tensor in tensors):
        return None
    return tuple((tensor.data_ptr(), tensor._version) for tensor in tensors)


class _Size:
    """Pictures of one size."""

    def __init__(self, marcher: Marcher, camera: Camera) -> None:
        self._marcher = marcher
        device, views, height, width = marcher.device, len(camera.intrinsics), camera.height, camera.width
        rays = views * height * width
        with torch.inference_mode(False):
            self._camera = camera.map(lambda tensor: torch.empty_like(tensor).contiguous())
            # One piece of memory, so that a picture is handed out by one copy.
            self._planes = torch.empty(6, -(-rays // 4) * 4, device=device)
        self._flat = (views, height, width)
        self._picture = self._views(self._planes)
        self._place: tuple[torch.cuda.CUDAGraph, PlacedBoxes] | None = None
        self._draws: dict[Plan, torch.cuda.CUDAGraph | None] = {}
        """None for plans by which a picture was launched from Python: that compiles what is recorded next."""

    def _views(self, planes: Tensor) -> Picture:
        views, height, width = self._flat
        rays = views * height * width
        rgb = planes[:3].view(-1)[: 3 * rays].view(*self._flat, 3)
        alpha, depth, first_hit = (plane[:rays].view(self._flat) for plane in planes[3:])
        return rgb, alpha, depth, first_hit

    def draw(self, camera: Camera) -> Rendering:
        """Draw what the marcher shows."""
        marcher, record = self._marcher, cuda_graph.usable(self._marcher.device)
        inputs = [camera.intrinsics, camera.world_to_camera]
        cuda_graph.copy_all([self._camera.intrinsics, self._camera.world_to_camera], inputs)
        scene = MarchScene(marcher.primitives, self._camera, marcher.settings, None, marcher.shapes, keep=False)

        def place() -> PlacedBoxes:
            own = (self._camera.intrinsics, self._camera.world_to_camera)
            return cuda_scene.place(scene, marcher.packed, marcher.geometry, *own)

        if record and self._draws:
            if self._place is None:
                self._place = cuda_graph.record(place)
            graph, placed = self._place
            graph.replay()
        else:
            placed = place()

        def draw(plan: Plan) -> None:
            def launches() -> None:
                cuda_scene.draw(scene, marcher.packed, placed, self._picture, plan)

            # Graphs read what `place` has recorded, so they follow it.
            if not (record and self._place and plan in self._draws):
                if len(self._draws) >= MOST:
                    self._draws.pop(next(iter(self._draws)))
                self._draws[plan] = None
                return launches()
            graph = self._draws[plan] or cuda_graph.record(launches)[0]
            self._draws[plan] = graph
            graph.replay()

        cuda_scene.drawn(scene, placed, draw)
        return Rendering(*self._views(self._planes.clone()))


_marchers: dict[tuple, Marcher | None] = {}
"""Marchers by the kind of their scenes; None after the first picture of a kind."""


def prepared(primitives: Primitives, settings: MarchSettings, shapes: Shapes) -> Marcher | None:
    """Return a marcher that shows these primitives if such were drawn before on this stream and thread."""
    position = primitives.position
    stream = torch.cuda.current_stream(position.device).cuda_stream
    key = (*position.shape[:2], position.device, settings, shapes, stream, threading.get_ident())
    if key not in _marchers:
        if len(_marchers) >= MOST:
            _marchers.pop(next(iter(_marchers)))
        _marchers[key] = None
        return None
    marcher = _marchers[key]
    if marcher is None:
        marcher = _marchers[key] = Marcher(primitives, settings, shapes)
    else:
        marcher.show(primitives)
    return marcher
