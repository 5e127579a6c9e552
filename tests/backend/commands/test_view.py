"""The viewer in a browser, without one."""

import dataclasses
import math
import types

import numpy as np
import pytest
import torch
from primdiffusion.commands.view import COARSE, Viewer, camera_of, theta_of
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.human import framing, generate, place
from scipy.spatial.transform import Rotation
from tiny_model import tiny_model


class Client:
    """A browser that looks at the human from the front."""

    def __init__(self, human, aspect=0.5):
        camera = framing(place(human))
        turned = Rotation.from_matrix(camera.world_to_camera[:, :3].T.numpy()).as_quat()
        self.camera = types.SimpleNamespace(
            wxyz=turned[[3, 0, 1, 2]], position=camera.position.numpy(), fov=math.radians(30), aspect=aspect
        )
        self.scene, self.pictures = self, []

    def set_background_image(self, image, format):
        self.pictures.append(image)


class Server:
    """As much of viser's server as the viewer calls."""

    def __init__(self, **clients):
        self.scene, self.gui, self.clients = self, self, dict(enumerate(clients.values()))

    def set_up_direction(self, direction):
        self.up = direction

    def add_slider(self, name, **settings):
        return types.SimpleNamespace(value=settings["initial_value"])

    def on_client_connect(self, handler):
        self.connected = handler

    def get_clients(self):
        return self.clients


@pytest.fixture(scope="module")
def human():
    return generate(tiny_model(), 3, steps=1)


def test_pictures_are_coarse_while_something_moves_then_sharp_then_none(human):
    client = Client(human)
    viewer = Viewer(human, Server(client=client), 60)
    assert [viewer.draw() for _ in range(3)] == [True, True, False]
    assert [picture.shape for picture in client.pictures] == [(60 // COARSE, 10, 3), (60, 30, 3)]
    sharp = client.pictures[-1]
    assert (sharp[0, 0] == 255).all()
    assert (sharp < 250).any(-1).mean() > 0.05
    viewer.sliders["left arm"].value = 70.0
    assert [viewer.draw() for _ in range(3)] == [True, True, False]
    assert np.abs(client.pictures[-1].astype(int) - sharp).mean() > 0.5
    client.camera.position = client.camera.position * 1.5
    assert viewer.draw()


def test_a_client_s_camera_is_the_marcher_s(human):
    camera, client = framing(place(human), 0.7, 40, 60), Client(human)
    turned = Rotation.from_matrix(camera.world_to_camera[:, :3].T.numpy()).as_quat()
    made = camera_of(turned[[3, 0, 1, 2]], camera.position.tolist(), client.camera.fov, width=40, height=60)
    for field in dataclasses.fields(camera):
        got, expected = (torch.as_tensor(getattr(one, field.name)) for one in (made, camera))
        torch.testing.assert_close(got, expected, atol=1e-4, rtol=1e-4)


def test_the_arm_s_slider_lowers_the_hand(human):
    lowered = place_hand(human, {"left arm": 60.0})
    assert place_hand(human, {})[1] - lowered[1] > 0.2


def place_hand(human, angles):
    from primdiffusion.body.model import BodyPose
    from primdiffusion.human import pose_body

    posed = pose_body(human.betas, BodyPose.from_axis_angle(torch.from_numpy(theta_of(angles))))
    return posed.joints[JOINT_NAMES.index("left_wrist"), :3, 3]


def test_the_real_server_takes_sliders_and_the_scene(human):
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        viewer = Viewer(human, server, 32)
        assert viewer.sliders["head"].value == 0
        assert not viewer.draw()
    finally:
        server.stop()
