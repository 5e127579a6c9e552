"""What boxes hold at points, against the readable marcher."""

import numpy as np
import torch
from export_people import ball, person
from primdiffusion.body.model import default_body
from primdiffusion.export.field import density_at, march_rays, pack_field, weights_at
from primdiffusion.human import framing, place
from primdiffusion.primitives.anchors import anchor_skin_weights, default_anchors
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.render.reference import trilinear, window


def test_density_is_the_sum_of_the_boxes_windowed_densities():
    primitives = place(person())
    points = primitives.position[::7] + 0.013
    offset = torch.einsum("nki,kij->nkj", points[:, None] - primitives.position, primitives.rotation)
    local = offset / primitives.half_extent
    point, box = (local.abs() < 1).all(-1).nonzero(as_tuple=True)
    inside = local[point, box]
    part = trilinear(primitives.density[:, None], box, inside)[:, 0] * window(inside)
    expected = torch.zeros(len(points)).index_add(0, point, part)
    found = density_at(pack_field(primitives), points.double().numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-2)
    assert found.max() > 100


def test_looking_along_rays_sees_what_the_marcher_draws():
    primitives = place(person())
    camera = framing(primitives, 0.4, 48, 48)
    drawn = march(primitives, camera, MarchSettings(step=0.001))
    origin, directions = camera.rays()
    rays = directions.reshape(-1, 3).double().numpy()
    origins = np.broadcast_to(origin.double().numpy(), rays.shape)
    colour, alpha = march_rays(pack_field(primitives), origins, rays, 12.0, 0.001)
    expected = drawn.alpha.reshape(-1).numpy()
    assert np.abs(alpha - expected).mean() < 2e-3
    full = expected > 0.99
    straight = drawn.rgb.reshape(-1, 3).numpy() / np.maximum(expected, 1e-6)[:, None]
    assert np.abs(colour - straight)[full].mean() < 0.01


def test_points_far_from_all_boxes_are_empty_and_have_no_weights():
    field = pack_field(place(person()))
    far = np.array([[5.0, 0.0, 0.0], [0.0, -9.0, 2.0]])
    assert not density_at(field, far).any()
    assert not weights_at(field, far, np.ones((1024, 24), np.float32)).any()


def test_boxes_without_extent_are_left_out():
    primitives = ball()
    flat = type(primitives)(**{**vars(primitives), "half_extent": torch.zeros(1, 3)})
    assert not density_at(pack_field(flat), np.zeros((1, 3))).any()


def test_a_point_on_one_leg_follows_that_leg_though_boxes_of_the_other_reach_it():
    primitives, body = place(person()), default_body()
    weights = anchor_skin_weights(default_anchors(), body).numpy()
    shaped = body.shape(torch.zeros(10))
    left_shin = (shaped.joints[4] + shaped.joints[7]).double().numpy()[None] / 2 + [[0.0, 0.0, 0.03]]
    found = weights_at(pack_field(primitives), left_shin, weights)[0]
    assert abs(found.sum() - 1) < 1e-5
    assert found[[1, 4, 7]].sum() > 0.99
