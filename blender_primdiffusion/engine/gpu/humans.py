"""Humans of the scene on the GPU: their payloads and reliefs, uploaded once, and their boxes where they are."""

from __future__ import annotations

from collections.abc import Iterable

from ...scene.human_file import FileVersion, file_version, read_payload
from ..boxes import Boxes, boxes_of
from ..picture import PosedHuman
from .caching import cache_until_exit
from .march import GpuPayload

PAYLOADS_KEPT = 4
"""Of humans that are no longer drawn; 4 MB each."""


class GpuHumans:
    """Payloads on the GPU, by file."""

    def __init__(self) -> None:
        self._payloads: dict[FileVersion, GpuPayload] = {}
        """The latest used last."""

    def placed(self, human: PosedHuman) -> tuple[GpuPayload, Boxes]:
        """Payload and boxes of one human. Raises OSError or ValueError for files, as `read_payload` and `boxes_of`."""
        version, boxes = file_version(human.file), boxes_of(human)
        payload = self._payloads.pop(version, None)
        if payload is None:
            tensors = read_payload(human.file)
            thickness = 2 * boxes.half_extent[:, 2] * boxes.density_scale
            payload = GpuPayload(tensors.rgb, tensors.density, thickness)
        self._payloads[version] = payload
        return payload, boxes

    def holds(self, human: PosedHuman) -> bool:
        """Whether the human's payload is on the GPU already."""
        return file_version(human.file) in self._payloads

    def keep_only(self, drawn: Iterable[PosedHuman]) -> None:
        """Free the payloads of others, but for the latest PAYLOADS_KEPT."""
        files = {human.file for human in drawn}
        others = [version for version in self._payloads if version.path not in files]
        for version in others[:-PAYLOADS_KEPT]:
            del self._payloads[version]


@cache_until_exit
def gpu_humans() -> GpuHumans:
    """The humans on the GPU."""
    return GpuHumans()
