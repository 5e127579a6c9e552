"""Pictures that are judged: joints and depth lie where the picture shows them, folders say what models do."""

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion.capture.poses import choose_poses
from primdiffusion.evaluation.images import JOINTS, SIDE, body_camera, folder_images, human_images, mesh_images
from primdiffusion.human import generate, pose_body
from primdiffusion.people.assets import open_assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.person import make_person
from primdiffusion.render.march import MarchSettings
from support.errors import refused
from support.tiny import tiny_model


@pytest.fixture(scope="module")
def human():
    return generate(tiny_model(), 0, 2)


@pytest.fixture(scope="module")
def image(human):
    """The left side of a human, which has views at 0, 90, 180 and 270 degrees."""
    drawn = human_images(human, choose_poses([], 1, 0), 4, MarchSettings(step=0.02), torch.device("cpu"))
    return [next(drawn), next(drawn)][1]


def test_a_camera_holds_the_body_from_every_side(human):
    vertices = pose_body(human.betas).vertices
    for yaw in (0.0, 0.7, 2.0):
        pixels, depth = body_camera(vertices, yaw).project(vertices)
        assert 0 < pixels.min() < pixels.max() < SIDE
        assert depth.min() > 1


def test_depth_is_along_the_optical_axis_and_joints_are_of_the_view(human, image):
    vertices = pose_body(human.betas, choose_poses([], 1, 0).map(lambda t: t[0])).vertices
    _, depth = body_camera(vertices, np.pi / 2).project(vertices)
    inside = image.mask & torch.isfinite(image.depth)
    assert inside.sum() > 1000
    assert float(depth.min()) - 0.2 < float(image.depth[inside].min()) < float(image.depth[inside].max())
    assert float(image.depth[inside].max()) < float(depth.max()) + 0.2
    assert not torch.isfinite(image.depth[~image.mask]).any()
    # From the left, the face looks to the left of the picture and both hips coincide.
    left, right = (image.joints[JOINTS.index(f"{side}_hip")] for side in ("left", "right"))
    assert (left - right).norm() < 12
    assert 8 < image.head_size < 60


def test_a_folder_gives_what_was_drawn(image, tmp_path):
    rgb, alpha = image.pixels, (255 * image.mask).to(torch.uint8)[..., None]
    Image.fromarray(rgb.numpy()).save(tmp_path / "one.png")
    Image.fromarray(torch.cat([rgb, alpha], -1).numpy()).save(tmp_path / "two.png")
    Image.new("RGB", (256, 256), "white").save(tmp_path / "white.png")
    one, two, white = folder_images(tmp_path)
    assert torch.equal(one.pixels, rgb)
    assert (one.joints, one.head_size) == (None, None)
    assert torch.isinf(one.depth).all()
    assert torch.equal(two.mask, image.mask)
    assert (two.pixels[~two.mask] == 255).all()
    assert white.pixels.shape == (SIDE, SIDE, 3)
    assert not white.mask.any()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda folder: (folder / "a.png").unlink(), "no pictures"),
        (lambda folder: Image.new("RGB", (8, 9)).save(folder / "a.png"), "8 x 9"),
        (lambda folder: (folder / "a.png").write_bytes(b"no picture"), "a.png"),
    ],
)
def test_a_folder_that_does_not_fit_is_one_sentence(tmp_path, spoil, words):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    spoil(tmp_path)
    with refused(ValueError, words):
        list(folder_images(tmp_path))


def test_meshes_are_drawn_around_their_joints():
    try:
        assets = open_assets()
    except FileNotFoundError as error:
        pytest.skip(str(error))
    person = make_person(assets, load_base_mesh(), 7)
    (image,) = mesh_images(person, choose_poses([], 1, 0), [[0.0]], 256)
    column, row = image.joints.round().long().unbind(-1)
    assert image.mask[row, column].all()
    side = [JOINTS.index(f"{side}_shoulder") for side in ("left", "right")]
    assert image.joints[side[0], 0] > image.joints[side[1], 0] + 20  # seen from the front
