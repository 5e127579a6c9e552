"""The GPU made ready to march, in steps that each stall the window for a moment: until then reliefs are drawn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..boxes import Boxes
from ..view import PinholeView
from .march import GpuMarcher, GpuPayload, gpu_marcher


class GpuStart:
    """For draw handlers and timers of Blender's main thread."""

    def __init__(self) -> None:
        self._steps: Iterator[None] | None = None
        self._marcher: GpuMarcher | None = None
        self.fault = ""
        """Why the GPU cannot march."""

    @property
    def working(self) -> bool:
        """Whether `advance` has something to do."""
        return self._steps is not None

    def marcher(self) -> GpuMarcher | None:
        """The marcher; None until it is ready, which `advance` brings about, or where the GPU cannot march."""
        if self._marcher is None and not self.fault and self._steps is None:
            self._steps = self._compiling()
        return None if self.fault else self._marcher

    def advance(self) -> bool:
        """Do a step; True when it was the last one."""
        if self._steps is None:
            return False
        try:
            if next(self._steps, self) is not self:
                return False
        except RuntimeError as error:
            self.fault = str(error)
        self._steps = None
        return True

    def failed(self, fault: str) -> None:
        """Nothing is marched any more."""
        self.fault, self._steps, self._marcher = fault, None, None

    def _compiling(self) -> Iterator[None]:
        marcher = gpu_marcher()
        if isinstance(marcher, str):
            raise RuntimeError(marcher)
        yield from marcher.compile()
        payload = GpuPayload(np.zeros((1, 3, 8, 8, 8)), np.ones((1, 8, 8, 8)))
        boxes = Boxes(np.array([[0.0, 0.0, 1.0]]), np.eye(3)[None], np.full((1, 3), 0.1))
        view = PinholeView(np.diag([8.0, 8.0, 1.0]), np.eye(3, 4), (0.0, 2.0), 8, 8)
        picture = marcher.march([(payload, boxes)] * 2, view, 0.1)
        yield
        picture.advance()
        picture.wait()
        self._marcher = marcher


gpu_start = GpuStart()
"""For all views."""
