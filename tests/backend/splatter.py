"""A small renderer of 3D Gaussian files, by the rule of their viewers: depth order, EWA footprints, alpha blending."""

from pathlib import Path

import numba
import numpy as np

C0 = 0.28209479177387814


def read_ply(path: Path) -> dict[str, np.ndarray]:
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    rows = np.frombuffer(body, "<f4").reshape(count, len(names))
    return {name: rows[:, i].astype(np.float64) for i, name in enumerate(names)}


def draw(ply: dict[str, np.ndarray], camera) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied colours as the file has them (display values) and alpha."""
    columns = lambda *names: np.stack([ply[name] for name in names], -1)  # noqa: E731
    rgb = np.clip(0.5 + C0 * columns("f_dc_0", "f_dc_1", "f_dc_2"), 0, None)
    opacity = 1 / (1 + np.exp(-ply["opacity"]))
    scale = np.exp(columns("scale_0", "scale_1", "scale_2"))
    w, x, y, z = columns("rot_0", "rot_1", "rot_2", "rot_3").T
    rotation = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).reshape(-1, 3, 3)  # fmt: skip
    view, k = camera.world_to_camera.double().numpy(), camera.intrinsics.double().numpy()
    centre = columns("x", "y", "z") @ view[:, :3].T + view[:, 3]
    order = np.argsort(centre[:, 2])
    half = view[:, :3] @ rotation * scale[:, None, :]
    jacobian = np.zeros((len(centre), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = k[0, 0] / centre[:, 2], k[1, 1] / centre[:, 2]
    jacobian[:, 0, 2] = -k[0, 0] * centre[:, 0] / centre[:, 2] ** 2
    jacobian[:, 1, 2] = -k[1, 1] * centre[:, 1] / centre[:, 2] ** 2
    flat = jacobian @ half
    covariance = flat @ flat.swapaxes(1, 2) + 0.3 * np.eye(2)
    middle = (centre[:, :2] / centre[:, 2:]) * k[[0, 1], [0, 1]] + k[:2, 2]
    picture, through = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    _blend(middle[order], np.linalg.inv(covariance)[order], opacity[order], rgb[order], picture, through)
    return picture, 1 - through


@numba.njit
def _blend(middle, inverse, opacity, rgb, picture, through):
    height, width = through.shape
    for n in range(len(middle)):
        a, b, c = inverse[n, 0, 0], inverse[n, 0, 1], inverse[n, 1, 1]
        determinant = a * c - b * b
        rx, ry = 3 * np.sqrt(c / determinant), 3 * np.sqrt(a / determinant)
        for row in range(max(int(middle[n, 1] - ry), 0), min(int(middle[n, 1] + ry) + 2, height)):
            for column in range(max(int(middle[n, 0] - rx), 0), min(int(middle[n, 0] + rx) + 2, width)):
                x, y = column + 0.5 - middle[n, 0], row + 0.5 - middle[n, 1]
                alpha = opacity[n] * np.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
                if alpha < 1 / 255:
                    continue
                for channel in range(3):
                    picture[row, column, channel] += through[row, column] * alpha * rgb[n, channel]
                through[row, column] *= 1 - alpha
