"""Pictures of posed humans that payloads are fitted to."""

from __future__ import annotations

import dataclasses

from jaxtyping import Float32, UInt8
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Frames


@dataclasses.dataclass(frozen=True)
class PosedView(TensorRecord):
    """A picture with its camera and the boxes in its pose, unbatched."""

    frames: Frames
    camera: Camera
    rgba: UInt8[Tensor, "height width 4"] | Float32[Tensor, "height width 4"]
    """Colours over black, and the mask: sRGB-encoded bytes for `descend`, linear floats for `fit_payload`."""
    weight: float = 1.0
    """Weight of the picture's mean square error in `fit_payload`."""

    def __post_init__(self) -> None:
        """Raise ValueError if the picture does not fit its camera or is not finite."""
        expected = (self.camera.height, self.camera.width, 4)
        if self.rgba.shape != expected or (self.rgba.is_floating_point() and not self.rgba.isfinite().all()):
            shape = tuple(self.rgba.shape)
            raise ValueError(f"a picture of shape {shape} does not fit its camera, or is not finite: give {expected}")
