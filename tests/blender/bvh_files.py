"""BVH files of other rigs, written for tests."""

from pathlib import Path

import numpy as np
import pytest
from blender_primdiffusion.formats.joints import JOINT_NAMES, PARENTS
from blender_primdiffusion.formats.poses.rotation import between, from_axis_angle

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation
FRAMES = 6
ORDERS = ["ZXY", "XYZ", "YZX", "ZYX", "XZY", "YXZ"]


def motion_of(spread: float = 0.35, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return from_axis_angle(rng.normal(0, spread, (FRAMES, 24, 3))), rng.normal(0, 0.5, (FRAMES, 3))


def along_x(rest: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A rest [24, 3] and rotations [F, 24, 3, 3] as Rokoko writes them: with all angles zero each bone lies along x.

    They put joints where joint rotations of SMPL from `rest` do.
    """
    own, flat = np.tile(np.eye(3), (24, 1, 1)), np.array(rest)
    for joint in range(24):
        children = [child for child, parent in enumerate(PARENTS) if parent == joint]
        if children:
            own[joint] = between(np.array([1.0, 0, 0]), rest[children[-1]] - rest[joint])
        else:
            own[joint] = own[PARENTS[joint]]
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            flat[joint] = flat[parent] + own[parent].T @ (rest[joint] - rest[parent])
    above = np.array([np.eye(3) if parent < 0 else own[parent] for parent in PARENTS])
    return flat, np.swapaxes(above, -1, -2) @ rotations @ own


def write_bvh(
    path: Path,
    rest: np.ndarray,
    rotations: np.ndarray,
    root: np.ndarray,
    names: dict[str, str],
    left_out: tuple[str, ...] = (),
    frame_time: str = "0.0083333",
) -> Path:
    """A BVH file of joints at rest [24, 3] that turn by [F, 24, 3, 3]; each joint with an Euler order of its own."""
    lines, columns = ["HIERARCHY"], []
    children = {j: [c for c, p in enumerate(PARENTS) if p == j and JOINT_NAMES[c] not in left_out] for j in range(24)}

    def joint(j: int, depth: int) -> None:
        pad, order = "\t" * depth, ORDERS[j % len(ORDERS)]
        offset = rest[j] - (rest[PARENTS[j]] if j else 0)
        lines.append(f"{pad}{'JOINT' if j else 'ROOT'} {names[JOINT_NAMES[j]]}")
        lines.append(f"{pad}{{\n{pad}\tOFFSET {offset[0]:.8f} {offset[1]:.8f} {offset[2]:.8f}")
        channels = [f"{axis}rotation" for axis in order]
        if j == 0:
            columns.append(root)
            channels = ["Xposition", "Yposition", "Zposition", *channels]
        columns.append(Rotation.from_matrix(rotations[:, j]).as_euler(order, degrees=True))
        lines.append(f"{pad}\tCHANNELS {len(channels)} {' '.join(channels)}")
        for child in children[j]:
            joint(child, depth + 1)
        if not children[j]:
            end = (rest[j] - rest[PARENTS[j]]) * 0.5
            lines.append(f"{pad}\tEnd Site\n{pad}\t{{\n{pad}\t\tOFFSET {end[0]} {end[1]} {end[2]}\n{pad}\t}}")
        lines.append(f"{pad}}}")

    joint(0, 0)
    lines += ["MOTION", f"Frames: {len(rotations)}", f"Frame Time: {frame_time}"]
    lines += [" ".join(f"{number:.7f}" for number in row) for row in np.concatenate(columns, -1)]
    path.write_text("\n".join(lines) + "\n")
    return path
