"""What released numbers mean: which way boxes face, how large they are, which steps are visited."""

import math

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.codec import SMALLEST_DELTA_S, ReleasedSlab
from primdiffusion.diffusion.schedule import released_steps, sqrt_linear
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.primitives.anchors import attach
from primdiffusion.primitives.body_setup import BodySetup, body_setup_from_files
from primdiffusion.primitives.primitives import GRID, RELEASED_FULL_DENSITY, Payload, Primitives, S
from primdiffusion.released.imported import Reference, reference_extents, rest_half_extent
from primdiffusion.render.march import MarchSettings, march
from released_files import save_body
from support.errors import refused


@pytest.fixture(scope="module")
def body_setup(tmp_path_factory) -> BodySetup:
    smpl, uv = save_body(tmp_path_factory.mktemp("body"))
    return body_setup_from_files(smpl, (uv,))


@pytest.fixture(scope="module")
def painted() -> torch.Tensor:
    """A slab, 0 ... 255, that looks different from every side: no axis of no box is symmetric."""
    generator = torch.Generator().manual_seed(0)
    values = 60 + 195 * torch.rand(S, 7, 1, S, 1, S, generator=generator).expand(-1, -1, GRID, -1, GRID, -1).clone()
    values[:, 4:] = torch.tensor([0.8, 1.3, 1.1])[:, None, None, None, None] * 255 / 20
    return values.reshape(56, GRID * S, GRID * S)


def network_values(slab: torch.Tensor) -> torch.Tensor:
    return (slab / 255 * 2 - 1) * 0.182


def marched_by_hand(slab: torch.Tensor, body_setup: BodySetup, k: int, camera: Camera) -> np.ndarray:
    """Alpha and linear colours of one box, by SPEC 1 to 4: millimetres, B = T x N, the marcher's reciprocal scale."""
    vertices = 1000 * body_setup.body.template.numpy()
    corners = vertices[body_setup.body.faces[body_setup.anchors.face[k]]]
    centre = body_setup.anchors.barycentric[k].numpy() @ corners
    corner_uv = body_setup.body.uv[body_setup.body.uv_faces[body_setup.anchors.face[k]]].numpy()
    tangent = np.linalg.solve(corner_uv[1:] - corner_uv[0], corners[1:] - corners[0])[0]
    tangent /= np.linalg.norm(tangent)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    frame = np.stack([tangent, np.cross(tangent, normal), normal], 1)
    assert np.linalg.det(frame) == pytest.approx(-1)
    row, column = divmod(k, GRID)
    box = slab[:, row * S : (row + 1) * S, column * S : (column + 1) * S].reshape(S, 7, S, S).double().numpy()
    delta_s = box[:, 4:].mean((0, 2, 3)) / 255 * 20
    scale = 10_000 / (1000 * body_setup.anchors.rest_half_extent[k].double().numpy()) * delta_s  # of a box of 10 m
    encoded = box[:, :3] / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)

    world_to_camera = camera.world_to_camera.double().numpy()
    origin = -1000 * world_to_camera[:, :3].T @ world_to_camera[:, 3]
    picture = np.zeros((camera.height, camera.width, 4))
    for v in range(camera.height):
        for u in range(camera.width):
            pixel = np.linalg.solve(camera.intrinsics.double().numpy(), [u + 0.5, v + 0.5, 1])
            direction = world_to_camera[:, :3].T @ pixel
            direction /= np.linalg.norm(direction)
            samples = (origin + np.arange(0.0, 1500.0, 1.0)[:, None] * direction - centre) @ frame * scale / 10_000
            for y in samples[np.abs(samples).max(1) < 1]:
                x, weight = (y + 1) / 2 * (S - 1), math.exp(-8 * (y**8).sum())
                low = np.minimum(x.astype(int), S - 2)
                density, colour = 0.0, np.zeros(3)
                for corner in np.ndindex(2, 2, 2):
                    share = np.prod(np.where(corner, x - low, 1 - (x - low)))
                    w, h, d = low + corner
                    density += share * box[d, 3, h, w]
                    colour += share * linear[d, :, h, w]
                increase = min(density / 255 * 0.0255 * weight, 1 - picture[v, u, 3])
                picture[v, u, 3] += increase
                picture[v, u, :3] += increase * colour
    return picture


@pytest.mark.parametrize("degrees", [-35, 40])
def test_a_painted_box_looks_as_by_the_released_conventions(body_setup, painted, degrees):
    k = 10 * GRID + 2  # on the drum's front left
    frames = attach(body_setup.anchors, body_setup.body.template, body_setup.body.faces)
    centre, normal = frames.position[k], frames.rotation[k, :, 2]
    sideways = frames.rotation[k, :, 0] * math.tan(math.radians(degrees)) + torch.tensor([0.0, 0.25, 0.0])
    camera = look_at(centre + 0.6 * (normal + sideways), centre, vertical_fov=math.radians(9), width=12, height=12)
    expected = marched_by_hand(painted, body_setup, k, camera)

    payload = ReleasedSlab().to_payload(network_values(painted), RELEASED_FULL_DENSITY)
    whole = Primitives.place(frames, payload)
    box = Primitives(*(getattr(whole, name)[k : k + 1] for name in vars(whole)))
    rendering = march(box, camera, MarchSettings(step=0.001))
    found = torch.cat([rendering.rgb, rendering.alpha[..., None]], -1).numpy()
    assert expected[..., 3].max() > 0.5
    assert np.abs(found - expected).max() < 0.012
    assert np.abs(found - expected).mean() < 0.002

    unturned = Payload(payload.rgb.flip(-2), payload.density.flip(-2), payload.delta_scale)
    mirrored = Primitives.place(frames, unturned)
    box = Primitives(*(getattr(mirrored, name)[k : k + 1] for name in vars(mirrored)))
    wrong = march(box, camera, MarchSettings(step=0.001))
    assert np.abs(wrong.alpha.numpy() - expected[..., 3]).max() > 0.03, "the painting must tell the sides apart"


def test_frames_stay_rotations_and_payloads_turn_along_b(painted):
    payload = ReleasedSlab().to_payload(network_values(painted), RELEASED_FULL_DENSITY)
    k, d, h, w = 5, 6, 1, 3
    assert payload.density[k, d, h, w] == pytest.approx(25.5 / 255 * painted[d * 7 + 3, S - 1 - h, 5 * S + w].item())
    assert payload.delta_scale[k].tolist() == pytest.approx([1 / 0.8, 1 / 1.3, 1 / 1.1], rel=1e-4)


def test_packing_is_the_inverse_of_unpacking(painted):
    codec, x = ReleasedSlab(), network_values(painted)
    assert codec.shape == (56, 256, 256)
    torch.testing.assert_close(codec.from_payload(codec.to_payload(x, 25.5), 25.5), x, atol=1e-5, rtol=0)


def test_stray_delta_scales_give_bounded_boxes_and_boxes_without_size_are_rejected(painted):
    stray = painted.clone()
    stray.view(S, 7, GRID * S, GRID * S)[:, 4:] = -3
    payload = ReleasedSlab().to_payload(network_values(stray), 25.5)
    assert payload.delta_scale.max() == pytest.approx(1 / SMALLEST_DELTA_S)
    with refused(ValueError, "reciprocal"):
        ReleasedSlab().from_payload(Payload(payload.rgb, payload.density, 0 * payload.delta_scale), 25.5)


def test_boxes_are_sized_as_at_released_inference(body_setup):
    """In millimetres: 15000 / d is the scale, below 350 it loses 70, half extents are 10000 / scale."""
    vertices = body_setup.body.template
    position = 1000 * (
        vertices[body_setup.body.faces[body_setup.anchors.face]] * body_setup.anchors.barycentric[..., None]
    ).sum(1)
    distance = np.sort(np.linalg.norm(position[:, None] - position[None], axis=-1), -1)[:, 1:24].mean(-1)
    scale = 15_000 / np.clip(distance, 5, 50)
    scale[scale < 350] -= 70
    found = rest_half_extent(position / 1000)
    np.testing.assert_allclose(1000 * found, np.repeat(10_000 / scale[:, None], 3, 1), rtol=1e-4)
    assert (scale < 280).any()
    assert (scale > 350).any()
    torch.testing.assert_close(reference_extents(body_setup, Reference.template()), found)


def test_a_narrower_reference_makes_smaller_boxes_and_its_place_does_not_matter(body_setup):
    narrow = torch.zeros(10)
    narrow[0] = -9.0
    turned = BodyPose.from_axis_angle(torch.zeros(72).index_fill(0, torch.tensor([1]), 1.0), torch.tensor([1.0, 2, 3]))
    template = reference_extents(body_setup, Reference.template())
    shrunk = reference_extents(body_setup, Reference(narrow, BodyPose.rest()))
    torch.testing.assert_close(reference_extents(body_setup, Reference(narrow, turned)), shrunk, rtol=1e-3, atol=1e-5)
    assert (shrunk <= template + 1e-6).all()
    assert (shrunk < 0.7 * template).any()


def test_released_chains():
    assert released_steps(1000, 100) == list(range(991, 0, -10))
    assert released_steps(1000, 1000) == list(range(999, -1, -1))
    assert released_steps(1000, 30)[0] == 958
    assert max(released_steps(1000, steps)[0] for steps in range(1, 501)) < sqrt_linear().length
    with refused(ValueError, "steps", "700", "500"):
        released_steps(1000, 700)
