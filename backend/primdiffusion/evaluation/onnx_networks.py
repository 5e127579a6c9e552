"""2D pose and monocular depth networks from ONNX files that a user names, run by onnxruntime (extra `evaluation`)."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from primdiffusion.evaluation.images import SIDE, TestImage
from primdiffusion.runtime.failures import optional_package

Normalisation = Literal["imagenet", "half"]
"""Mean and standard deviation of a network's inputs: of ImageNet (RTMPose, ViTPose, MiDaS, Depth Anything), or 0.5 and
0.5 (DPT)."""
DepthValues = Literal["inverted", "depth"]
"""Whether larger values of a depth network are nearer (MiDaS, DPT, Depth Anything) or farther."""
MEAN_STD = {
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "half": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
}
BOX_PADDING = 1.25
"""Size of the crop given to a pose network over that of the human's bounding box."""
POSE_SIZE, DEPTH_SIZE = (256, 192), (384, 384)
"""Height and width of inputs where the file leaves them open."""
LARGEST_SIZE = 2048
"""Height and width of a network's input, pixels."""
COCO_FIRST, COCO_LAST = 5, 17
"""COCO's keypoints from the left shoulder to the right ankle, in the order of `images.JOINTS`."""


@dataclasses.dataclass(frozen=True, eq=False)
class OnnxNetwork:
    """A network with one picture as its input."""

    path: Path
    session: Any
    """onnxruntime.InferenceSession."""
    height: int
    width: int

    def run(self, picture: Float[Tensor, "3 h w"], normalisation: Normalisation) -> list[np.ndarray]:
        """Outputs for a picture in [0, 1]. Raises ValueError if the network rejects it."""
        mean, std = (torch.tensor(values)[:, None, None] for values in MEAN_STD[normalisation])
        given = ((picture - mean) / std)[None].numpy().astype(np.float32)
        try:
            return self.session.run(None, {self.session.get_inputs()[0].name: given})
        except Exception as error:  # onnxruntime raises classes of its own
            raise ValueError(f"{self.path} failed on a picture ({_first_line(error)}): give another file") from error


def open_onnx(path: Path, size: tuple[int, int]) -> OnnxNetwork:
    """Open a network whose input is [1, 3, h, w]; `size` is h, w where the file leaves them open.

    Deterministic: one thread, on the CPU. Raises FileNotFoundError, MissingPackageError without onnxruntime, and
    ValueError for another file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no ONNX file at {path}: check the path")
    onnxruntime = optional_package("onnxruntime", "evaluation")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises classes of its own
        raise ValueError(f"{path} is not a readable ONNX file ({_first_line(error)}): download it again") from error
    inputs = session.get_inputs()
    shape = inputs[0].shape if len(inputs) == 1 else ()
    if len(shape) != 4 or shape[1] not in (3, None) or inputs[0].type != "tensor(float)":
        raise ValueError(f"{path} does not take one picture [1, 3, height, width] of float32: give another network")
    height, width = (
        given if isinstance(given, int) and given > 0 else own for given, own in zip(shape[2:], size, strict=True)
    )
    if max(height, width) > LARGEST_SIZE:
        raise ValueError(
            f"{path} takes pictures of {width} x {height} pixels, over {LARGEST_SIZE}: give another network"
        )
    return OnnxNetwork(path, session, height, width)


@dataclasses.dataclass(frozen=True)
class PoseNetwork:
    """A top-down pose network of COCO's 17 keypoints, with SimCC or heatmap outputs (RTMPose, ViTPose, HRNet)."""

    network: OnnxNetwork

    def joints(self, image: TestImage) -> Float[Tensor, "12 2"] | None:
        """The joints `images.JOINTS` in pixels; None for a picture without a human. Raises ValueError."""
        if not image.mask.any():
            return None
        height, width = self.network.height, self.network.width
        rows, columns = (image.mask.any(1 - axis).nonzero()[:, 0] for axis in (0, 1))
        low = torch.tensor([float(columns[0]), float(rows[0])])
        high = torch.tensor([float(columns[-1]) + 1, float(rows[-1]) + 1])
        extent = BOX_PADDING * (high - low)
        scale = torch.maximum(extent[0] / width, extent[1] / height)  # pixels of the picture per pixel of the crop
        corner = (low + high) / 2 - scale * torch.tensor([width, height]) / 2
        crop = _crop(image, corner, float(scale), height, width)
        outputs = self.network.run(crop, "imagenet")
        found = _decoded(outputs, height, width, self.network.path)[COCO_FIRST:COCO_LAST]
        return corner + found * scale


def open_pose_network(path: Path) -> PoseNetwork:
    """Open a pose network. Raises as `open_onnx`."""
    return PoseNetwork(open_onnx(path, POSE_SIZE))


def _crop(image: TestImage, corner: Tensor, scale: float, height: int, width: int) -> Float[Tensor, "3 h w"]:
    x = (corner[0] + scale * (torch.arange(width) + 0.5)) / image.rgb.shape[1] * 2 - 1
    y = (corner[1] + scale * (torch.arange(height) + 0.5)) / image.rgb.shape[0] * 2 - 1
    grid = torch.stack([x.expand(height, width), y[:, None].expand(height, width)], -1)
    dark = 1 - image.pixels.movedim(-1, 0)[None].float() / 255  # outside the picture is white
    return 1 - functional.grid_sample(dark, grid[None], align_corners=False)[0]


def _decoded(outputs: list[np.ndarray], height: int, width: int, path: Path) -> Float[Tensor, "k 2"]:
    """x, y of keypoints in pixels of the crop: maxima of SimCC's two rows, or of heatmaps, moved a quarter of a cell
    towards the larger neighbour."""
    shapes = [output.shape for output in outputs]
    if len(outputs) == 2 and all(len(shape) == 3 and shape[:2] == (1, shapes[0][1]) for shape in shapes):
        axes = [
            output[0].argmax(-1) * (side / output.shape[-1])
            for output, side in zip(outputs, (width, height), strict=True)
        ]
        found = np.stack(axes, -1)
    elif len(outputs) == 1 and len(shapes[0]) == 4 and shapes[0][0] == 1:
        maps = outputs[0][0]
        count, rows, columns = maps.shape
        best = maps.reshape(count, -1).argmax(-1)
        padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)), mode="edge")
        row, column, number = best // columns + 1, best % columns + 1, np.arange(count)
        x = column - 1 + 0.25 * np.sign(padded[number, row, column + 1] - padded[number, row, column - 1])
        y = row - 1 + 0.25 * np.sign(padded[number, row + 1, column] - padded[number, row - 1, column])
        found = np.stack([x * (width / columns), y * (height / rows)], -1)
    else:
        raise ValueError(f"{path} gives outputs of shapes {shapes}: give a pose network with SimCC or heatmap outputs")
    if len(found) < COCO_LAST:
        raise ValueError(f"{path} finds {len(found)} keypoints: give a network of COCO's 17")
    return torch.from_numpy(found).float()


@dataclasses.dataclass(frozen=True)
class DepthNetwork:
    """A monocular depth network with one output [1, h, w] or [1, 1, h, w]."""

    network: OnnxNetwork
    normalisation: Normalisation
    values: DepthValues

    def inverted(self, image: TestImage) -> Float[Tensor, "h w"]:
        """Inverted depth up to scale and offset, of the picture's size. Raises ValueError."""
        size = (self.network.height, self.network.width)
        values = functional.interpolate(
            image.pixels.movedim(-1, 0)[None].float() / 255,
            size,
            mode="bicubic",
            align_corners=False,
            antialias=True,
        )
        outputs = self.network.run(values[0].clamp(0, 1), self.normalisation)
        found = np.squeeze(outputs[0])
        if found.ndim != 2:
            raise ValueError(
                f"{self.network.path} gives an output of shape {outputs[0].shape}: give a network of depth [1, h, w]"
            )
        depth = torch.from_numpy(found.astype(np.float32))[None, None]
        depth = functional.interpolate(depth, (SIDE, SIDE), mode="bilinear", align_corners=False)[0, 0]
        return depth if self.values == "inverted" else 1 / depth.clamp_min(1e-6)


def open_depth_network(path: Path, normalisation: Normalisation, values: DepthValues) -> DepthNetwork:
    """Open a depth network. Raises as `open_onnx`."""
    return DepthNetwork(open_onnx(path, DEPTH_SIZE), normalisation, values)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)[:200]
