"""The default body's anchors and the frames they have on it."""

import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.formats.body_layout import (
    LARGEST_IN_PLANE,
    LARGEST_STRETCH,
    NORMAL_HALF_EXTENT,
    SPACING_TO_HALF_EXTENT,
)
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.geometry.surface import surface_points, vertex_normals
from primdiffusion.primitives.anchors import (
    CHARTS,
    Anchors,
    anchor_skin_weights,
    attach,
    default_anchors,
    stretched,
    tangent_plane,
)
from primdiffusion.primitives.primitives import GRID, K
from support.errors import refused

BODY = default_body()
ANCHORS = default_anchors()
REST = attach(ANCHORS, BODY.template, BODY.faces)
MIRROR = torch.tensor([-1.0, 1.0, 1.0])


def random_vertices(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    theta = 0.5 * torch.randn(count, 72, generator=generator)
    betas = torch.randn(count, 10, generator=generator)
    return BODY.shape(betas).pose(BodyPose.from_axis_angle(theta)).vertices


def test_every_cell_is_on_the_body():
    assert ANCHORS.face.shape == (K,)
    assert int(ANCHORS.face.min()) >= 0
    assert int(ANCHORS.face.max()) < len(BODY.faces)
    assert float(ANCHORS.barycentric.min()) >= 0
    assert torch.allclose(ANCHORS.barycentric.sum(-1), torch.ones(K), atol=1e-6)


def test_frames_are_rotations_in_any_pose_and_shape():
    rotation = attach(ANCHORS, random_vertices(6), BODY.faces).rotation
    identity = torch.eye(3).expand_as(rotation)
    assert torch.allclose(rotation.mT @ rotation, identity, atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(6, K), atol=1e-5)


def test_the_columns_are_tangent_bitangent_normal():
    tangent, bitangent, normal = REST.rotation.unbind(-1)
    du, dv = tangent_plane(ANCHORS, BODY.template)
    assert torch.allclose(tangent, torch.nn.functional.normalize(du, dim=-1), atol=1e-6)
    assert torch.allclose(bitangent, torch.linalg.cross(normal, tangent), atol=1e-6)
    assert ((bitangent * dv).sum(-1) > 0).all()


def test_normals_point_out_of_the_body():
    """An anchor may lie on the side of a finger or toe while its cell covers the back of the hand, but nowhere else."""
    skin = surface_points(vertex_normals(BODY.template, BODY.faces), BODY.faces, ANCHORS.face, ANCHORS.barycentric)
    outward = (REST.rotation[..., 2] * torch.nn.functional.normalize(skin, dim=-1)).sum(-1)
    divided = torch.tensor([name.endswith(("hand", "foot")) for name in CHARTS])[ANCHORS.chart]
    assert float(outward[~divided].min()) > 0.9
    assert float((outward[divided] > 0.5).float().mean()) > 0.85


def test_frames_move_rigidly_with_the_body():
    vertices = random_vertices(1)[0].double()
    anchors = ANCHORS.to(dtype=torch.float64)
    turn = axis_angle_to_matrix(torch.tensor([0.3, -1.1, 0.7], dtype=torch.float64))
    shift = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    before = attach(anchors, vertices, BODY.faces)
    after = attach(anchors, vertices @ turn.T + shift, BODY.faces)
    assert torch.allclose(after.position, before.position @ turn.T + shift, atol=1e-6)
    assert torch.allclose(after.rotation, turn @ before.rotation, atol=1e-5)


def test_the_layout_is_mirror_symmetric():
    """Column c and 31 - c are each other's mirror image; u runs the other way, so T keeps x and loses y, z signs."""
    position = REST.position.reshape(GRID, GRID, 3)
    normal = REST.rotation[..., 2].reshape(GRID, GRID, 3)
    tangent = REST.rotation[..., 0].reshape(GRID, GRID, 3)
    assert torch.allclose(position, position.flip(1) * MIRROR, atol=2e-6)
    assert torch.allclose(normal, normal.flip(1) * MIRROR, atol=2e-3)
    assert torch.allclose(tangent, -tangent.flip(1) * MIRROR, atol=2e-3)
    extent = ANCHORS.rest_half_extent.reshape(GRID, GRID, 3)
    assert torch.allclose(extent, extent.flip(1), atol=1e-5)


def test_charts_name_the_side_of_the_person():
    for index, name in enumerate(CHARTS):
        x = REST.position[ANCHORS.chart == index, 0]
        assert len(x) > 0
        if name.startswith("left"):
            assert float(x.min()) > 0
        if name.startswith("right"):
            assert float(x.max()) < 0


def test_cells_are_spread_evenly_enough():
    """The layout's own figures (docs/results/layout.json), with a margin: a broken bake shows here."""
    spacing = torch.stack(tangent_plane(ANCHORS, BODY.template)).norm(dim=-1)
    assert float(spacing.max()) < 0.080
    assert float(spacing.min()) > 0.010
    nearest = torch.cdist(BODY.template, REST.position).min(-1).values
    assert float(nearest.max()) < 0.045
    assert float(nearest.mean()) < 0.018


def test_half_extents_follow_the_spacing_and_the_region():
    du, dv = (edge.norm(dim=-1) for edge in tangent_plane(ANCHORS, BODY.template))
    extent = ANCHORS.rest_half_extent
    for index, name in enumerate(CHARTS):
        region = name.split("_")[-1]
        cells = ANCHORS.chart == index
        assert torch.allclose(extent[cells, 2], torch.tensor(NORMAL_HALF_EXTENT[region]))
        expected = (SPACING_TO_HALF_EXTENT * torch.stack([du[cells], dv[cells]], -1)).clamp(
            0.008, LARGEST_IN_PLANE[region]
        )
        assert torch.allclose(extent[cells, :2], expected)


def test_tangent_planes_do_not_depend_on_where_the_body_stands():
    anchors = ANCHORS.to(dtype=torch.float64)
    here = tangent_plane(anchors, BODY.template.double())
    there = tangent_plane(anchors, BODY.template.double() + 100)
    assert torch.allclose(torch.stack(here), torch.stack(there), atol=2e-5)


def test_a_batch_is_its_members():
    vertices = random_vertices(4).unflatten(0, (2, 2))
    together = attach(ANCHORS, vertices, BODY.faces)
    alone = attach(ANCHORS, vertices[1, 0], BODY.faces)
    for field in ("position", "rotation", "half_extent"):
        assert torch.allclose(getattr(together, field)[1, 0], getattr(alone, field), atol=1e-6)


def test_attach_has_the_gradients_of_finite_differences():
    few = slice(100, 104)
    used = torch.cat([ANCHORS.stencil_vertex[few].flatten(), BODY.faces[ANCHORS.face[few]].flatten()]).unique()
    position = torch.full((len(BODY.template),), -1)
    position[used] = torch.arange(len(used))
    anchors = Anchors(
        face=torch.arange(4),
        barycentric=ANCHORS.barycentric[few].double(),
        rest_half_extent=ANCHORS.rest_half_extent[few].double(),
        stencil_vertex=position[ANCHORS.stencil_vertex[few]].clamp_min(0),
        stencil_du=ANCHORS.stencil_du[few].double(),
        stencil_dv=ANCHORS.stencil_dv[few].double(),
        chart=ANCHORS.chart[few],
    )
    faces = position[BODY.faces[ANCHORS.face[few]]]
    vertices = BODY.template[used].double().requires_grad_()

    def frames(v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        attached = attach(anchors, v, faces)
        return attached.position, attached.rotation

    assert torch.autograd.gradcheck(frames, (vertices,))


def test_skin_weights_of_anchors_add_up_to_one_and_carry_them_along():
    """Far from the joints linear blend skinning of an anchor and the anchor on the skinned mesh agree."""
    weights = anchor_skin_weights(ANCHORS, BODY)
    assert torch.allclose(weights.sum(-1), torch.ones(K), atol=1e-4)
    posed = BODY.shape(torch.zeros(10)).pose(BodyPose.from_axis_angle(0.3 * torch.ones(72)))
    skinning = torch.einsum("kj,jmn->kmn", weights, posed.skinning)
    carried = (skinning @ torch.cat([REST.position, torch.ones(K, 1)], -1)[..., None])[:, :3, 0]
    rigid = weights.max(-1).values > 0.999
    assert int(rigid.sum()) > 100
    assert torch.allclose(carried[rigid], attach(ANCHORS, posed.vertices, BODY.faces).position[rigid], atol=1e-3)


def test_vertices_that_are_not_finite_are_rejected():
    vertices = BODY.template.clone()
    vertices[17, 1] = torch.nan
    with refused(ValueError, "pose"):
        attach(ANCHORS, vertices, BODY.faces)


def test_boxes_follow_the_skin_where_a_pose_stretches_it():
    assert torch.equal(stretched(REST, ANCHORS, BODY.template, BODY.template).half_extent, REST.half_extent)
    for factor in (0.8, 1.3, LARGEST_STRETCH, 3.0):
        grown = stretched(REST, ANCHORS, factor * BODY.template, BODY.template).half_extent / REST.half_extent
        expected = torch.tensor([min(max(factor, 1.0), LARGEST_STRETCH)] * 2 + [1.0])
        assert torch.allclose(grown, expected.expand_as(grown), rtol=1e-4)
