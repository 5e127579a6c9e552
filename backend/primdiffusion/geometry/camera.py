"""Pinhole cameras in the OpenCV convention: x right, y down, z forward, metres; pixel centres at +0.5."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.records import TensorRecord


@dataclasses.dataclass(frozen=True)
class Camera(TensorRecord):
    """A camera, or a batch of cameras of one image size: `x_pixel ~ intrinsics @ (world_to_camera @ [x_world, 1])`.

    >>> pixels, depth = pd.framing(boxes).project(boxes.position)
    >>> pixels.shape  # x from the left and y from the top of the picture
    torch.Size([1024, 2])
    """

    intrinsics: Float[Tensor, "*#c 3 3"]
    """Focal lengths and principal point, pixels."""
    world_to_camera: Float[Tensor, "*#c 3 4"]
    """[R | t], metres."""
    width: int
    height: int

    @property
    def position(self) -> Float[Tensor, "*#c 3"]:
        """The centre of projection in the world, -R^T t."""
        return -(self.world_to_camera[..., :3].mT @ self.world_to_camera[..., 3:])[..., 0]

    def rays(self) -> tuple[Float[Tensor, "*#c 3"], Float[Tensor, "*#c height width 3"]]:
        """The common origin and the unit world direction of the ray through each pixel centre (SPEC 4)."""
        in_world = self._directions() @ self.world_to_camera[..., None, :, :3]
        return self.position, torch.nn.functional.normalize(in_world, dim=-1)

    def secants(self) -> Float[Tensor, "*#c height width"]:
        """Distance along the ray through each pixel centre per metre along the optical axis."""
        return self._directions().norm(dim=-1)

    def _directions(self) -> Float[Tensor, "*#c height width 3"]:
        """Directions of the rays through pixel centres in the camera's axes, z = 1."""
        k = self.intrinsics[..., None, None]
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=k.dtype, device=k.device) + 0.5,
            torch.arange(self.width, dtype=k.dtype, device=k.device) + 0.5,
            indexing="ij",
        )
        y = (v - k[..., 1, 2, :, :]) / k[..., 1, 1, :, :]
        x = (u - k[..., 0, 2, :, :] - k[..., 0, 1, :, :] * y) / k[..., 0, 0, :, :]
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)

    def moved_in_picture(self, right: float, down: float) -> Camera:
        """Shift the principal point, so that what was seen at pixel (u, v) is seen at (u + right, v + down)."""
        shift = torch.zeros_like(self.intrinsics)
        shift[..., 0, 2], shift[..., 1, 2] = right, down
        return dataclasses.replace(self, intrinsics=self.intrinsics + shift)

    def crop(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of a crop that starts at pixel (left, top); pixels keep their rays."""
        return dataclasses.replace(self.moved_in_picture(float(-left), float(-top)), width=width, height=height)

    def every(self, stride: int, left: int, top: int) -> Camera:
        """The camera of every stride-th pixel of every stride-th row, from (left, top) on; pixels keep their rays."""
        moved = self.moved_in_picture((stride - 1) / 2 - left, (stride - 1) / 2 - top).intrinsics
        intrinsics = torch.cat([moved[..., :2, :] / stride, moved[..., 2:, :]], dim=-2)
        width, height = -(-(self.width - left) // stride), -(-(self.height - top) // stride)
        return dataclasses.replace(self, intrinsics=intrinsics, width=width, height=height)

    def project(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
        """Pixel coordinates and depth along the optical axis; points behind the camera have depth <= 0.

        Unbatched cameras only.
        """
        in_camera = points @ self.world_to_camera[:, :3].T + self.world_to_camera[:, 3]
        depth = in_camera[..., 2]
        homogeneous = in_camera @ self.intrinsics.T
        return homogeneous[..., :2] / homogeneous[..., 2:], depth


def look_at(
    position: Float[Tensor, "3"],
    target: Float[Tensor, "3"],
    *,
    vertical_fov: float,
    width: int,
    height: int,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Camera:
    """A camera at `position` with `target` at the image centre; `vertical_fov` in radians, square pixels.

    Raises ValueError if position and target coincide or the view direction is parallel to `up`.
    """
    forward = target - position
    right = torch.linalg.cross(forward, torch.as_tensor(up, dtype=position.dtype, device=position.device))
    if right.norm() < 1e-8 * max(1.0, float(forward.norm())):
        raise ValueError(
            f"cannot look from {position.tolist()} at {target.tolist()} with up {up}: move one of the points"
        )
    forward, right = torch.nn.functional.normalize(forward, dim=0), torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    focal = height / (2 * math.tan(vertical_fov / 2))
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).to(position)
    return Camera(intrinsics, torch.cat([rotation, -(rotation @ position)[:, None]], dim=1), width, height)
