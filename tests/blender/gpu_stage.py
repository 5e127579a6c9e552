"""What the tests of the GPU's marcher share: humans of the backend, cameras by hand, pixels of textures."""

import gpu
import numpy as np

from blender_primdiffusion.engine.boxes import Boxes
from blender_primdiffusion.engine.view import PinholeView

REST = np.tile(np.eye(3), (24, 1, 1))


def placed(backend, rotations=REST, translation=(0.0, 0.0, 0.0), world=None) -> dict[str, np.ndarray]:
    """A person's boxes, as the backend poses them, and the file that holds them."""
    file = backend.folder / f"{next(backend.files)}.npz"
    world = np.eye(4) if world is None else world
    person = {"folder": str(backend.folder), "rotations": np.asarray(rotations).tolist()}
    person |= {"translation": list(translation), "world": np.asarray(world).tolist()}
    backend.oracle.ask({"place": person, "out": str(file)})
    with np.load(file) as fields:
        return {**fields, "file": str(file)}


def boxes_of(fields: dict) -> Boxes:
    return Boxes(fields["position"], fields["rotation"], fields["half_extent"])


def pinhole(target, back, size=(64, 96), angle=0.6, clip=(0.01, 100.0)) -> PinholeView:
    """A camera that looks at `target` from `back` of it; the picture's height sees `angle`."""
    back = np.asarray(back, float)
    eye, ahead = target + back, -back / np.linalg.norm(back)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    focal = size[1] / 2 / np.tan(angle / 2)
    intrinsics = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    return PinholeView(intrinsics, np.concatenate([turn, -(turn @ eye)[:, None]], 1), clip, *size)


def read(texture: gpu.types.GPUTexture, view: PinholeView) -> np.ndarray:
    """Pixels [h, w, ...], top row first."""
    values = np.array(texture.read()).reshape(view.height, view.width, -1)[::-1]
    return values[..., 0] if texture.format == "R32F" else values
