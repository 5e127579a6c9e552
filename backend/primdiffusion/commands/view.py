"""Show a human in a browser: `primdiffusion view`. The marcher draws each client's picture from its camera."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from primdiffusion.body.model import BodyPose
from primdiffusion.commands.options import ViewCommand
from primdiffusion.device import best_device
from primdiffusion.failures import optional_package
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import VERTICAL_FOV, Human, framing, place
from primdiffusion.human_file import load_human
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import march

SLIDERS = {
    "left arm": ("left_shoulder", 2, -1),
    "right arm": ("right_shoulder", 2, 1),
    "left elbow": ("left_elbow", 1, -1),
    "right elbow": ("right_elbow", 1, 1),
    "left leg": ("left_hip", 0, -1),
    "right leg": ("right_hip", 0, -1),
    "left knee": ("left_knee", 0, 1),
    "right knee": ("right_knee", 0, 1),
    "head": ("head", 1, 1),
}
"""Joint, axis and sign of each slider; positive angles lower arms, bend elbows and knees, lift legs, turn left."""
LARGEST_ANGLE = 120.0
"""Degrees."""
COARSE = 3
"""How much smaller pictures are while the camera or the pose moves."""
IDLE_S = 0.03
BACKGROUND = (1.0, 1.0, 1.0)


class Viewer:
    """Sends each client of a viser server the picture from its camera: coarse at once, then sharp."""

    def __init__(self, human: Human, server: Any, size: int) -> None:
        self.server, self.size = server, size
        self._drawn: dict[int, tuple[tuple, int]] = {}
        self._placed = functools.lru_cache(maxsize=1)(functools.partial(placed, human))
        rest = self._placed(())
        middle = rest.position.mean(0).tolist()
        start = framing(rest).position.tolist()
        server.scene.set_up_direction("+y")
        self.sliders = {
            name: server.gui.add_slider(name, min=-LARGEST_ANGLE, max=LARGEST_ANGLE, step=1.0, initial_value=0.0)
            for name in SLIDERS
        }

        def frame(client: Any) -> None:
            client.camera.position, client.camera.look_at, client.camera.fov = start, middle, VERTICAL_FOV

        server.on_client_connect(frame)

    def draw(self) -> bool:
        """Draw for every client whose picture is not up to date; returns whether there was one."""
        angles = tuple((name, float(slider.value)) for name, slider in self.sliders.items())
        clients, busy = self.server.get_clients(), False
        self._drawn = {number: drawn for number, drawn in self._drawn.items() if number in clients}
        for number, client in clients.items():
            seen = client.camera
            view = (tuple(seen.wxyz), tuple(seen.position), float(seen.fov), float(seen.aspect))
            before, fineness = self._drawn.get(number, (None, 0))
            if before == (view, angles) and fineness == 1:
                continue
            coarse = COARSE if before != (view, angles) else 1
            height = max(1, self.size // coarse)
            camera = camera_of(*view[:3], width=max(1, round(height * view[3])), height=height)
            client.scene.set_background_image(picture(self._placed(angles), camera), format="jpeg")
            self._drawn[number] = ((view, angles), coarse)
            busy = True
        return busy


def placed(human: Human, angles: Sequence[tuple[str, float]]) -> Primitives:
    """The human's primitives, on the device that draws, with the sliders at these angles (degrees)."""
    pose = BodyPose.from_axis_angle(torch.from_numpy(theta_of(dict(angles))))
    return place(human, pose).to(best_device())


def theta_of(angles: Mapping[str, float]) -> Float[ndarray, "72"]:
    """SMPL's pose vector (24 axis angles, radians) of slider angles in degrees; KeyError for another slider."""
    theta = np.zeros((len(JOINT_NAMES), 3), np.float32)
    for name, degrees in angles.items():
        joint, axis, sign = SLIDERS[name]
        theta[JOINT_NAMES.index(joint), axis] = sign * math.radians(degrees)
    return theta.flatten()


def camera_of(wxyz: Sequence[float], position: Sequence[float], fov: float, *, width: int, height: int) -> Camera:
    """The camera of a viser client: quaternion and position of the camera in the world, vertical `fov` in radians."""
    world_from_camera = Rotation.from_quat([*wxyz[1:], wxyz[0]]).as_matrix()
    shift = -world_from_camera.T @ np.asarray(position, np.float64)
    focal = height / (2 * math.tan(fov / 2))
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    world_to_camera = torch.from_numpy(np.concatenate([world_from_camera.T, shift[:, None]], 1)).float()
    return Camera(intrinsics, world_to_camera, width, height)


def picture(primitives: Primitives, camera: Camera) -> UInt8[ndarray, "h w 3"]:
    """Render over white, sRGB."""
    rendering = march(primitives, camera.to(primitives.position.device), background=BACKGROUND)
    return (encode_srgb(rendering.rgb.clamp(0, 1)) * 255).round().byte().cpu().numpy()


def run(command: ViewCommand) -> None:
    """Print the address, and draw until Ctrl-C. Raises MissingPackageError, and as load_human."""
    viser = optional_package("viser", "viewer")
    human = load_human(command.human)
    server = viser.ViserServer(host="127.0.0.1", port=command.port, verbose=False)
    try:
        viewer = Viewer(human, server, command.size)
        print(f"http://127.0.0.1:{server.get_port()}  (stop with Ctrl-C)", flush=True)
        while True:
            if not viewer.draw():
                time.sleep(IDLE_S)
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
