"""Points, normals and tangent planes on meshes."""

import numpy as np
import pytest
import torch
import trimesh
from primdiffusion.geometry import textured_mesh
from primdiffusion.geometry.surface import (
    face_cross,
    signed_volume,
    surface_points,
    uv_gradient,
    vertex_normals,
)

CUBE = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)], dtype=torch.float64)
CUBE_FACES = torch.tensor(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


def test_a_barycentric_point_is_the_weighted_sum_of_its_corners():
    point = surface_points(CUBE, CUBE_FACES, torch.tensor([0]), torch.tensor([[0.2, 0.3, 0.5]], dtype=torch.float64))
    assert torch.allclose(point, torch.tensor([[0.0, 0.5, 0.8]], dtype=torch.float64))


def test_points_of_a_batch_are_the_points_of_its_members():
    batch = torch.randn(2, 3, 8, 3, dtype=torch.float64)
    face, barycentric = torch.tensor([3, 7]), torch.rand(2, 3, dtype=torch.float64)
    together = surface_points(batch, CUBE_FACES, face, barycentric)
    assert torch.equal(together[1, 2], surface_points(batch[1, 2], CUBE_FACES, face, barycentric))


def test_surface_points_have_the_gradients_of_finite_differences():
    face, barycentric = torch.tensor([3, 7]), torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    vertices = CUBE.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda v, b: surface_points(v, CUBE_FACES, face, b), (vertices, barycentric))


def test_a_unit_cube_encloses_one_cubic_metre_and_less_than_nothing_inside_out():
    assert signed_volume(CUBE, CUBE_FACES).item() == pytest.approx(1.0)
    assert signed_volume(CUBE, CUBE_FACES.flip(1)).item() == pytest.approx(-1.0)


def test_face_normals_point_out_of_the_cube_and_are_twice_the_area_long():
    cross = face_cross(CUBE, CUBE_FACES)
    centre = CUBE[CUBE_FACES].mean(1) - 0.5
    assert ((cross * centre).sum(-1) > 0).all()
    assert torch.allclose(cross.norm(dim=-1), torch.ones(12, dtype=torch.float64))


def test_vertex_normals_of_a_cube_point_along_its_diagonals_and_unused_vertices_get_none():
    vertices = torch.cat([CUBE, CUBE.new_tensor([[5.0, 5.0, 5.0]])])
    normals = vertex_normals(vertices, CUBE_FACES)
    diagonal = torch.nn.functional.normalize(CUBE - 0.5, dim=-1)
    assert ((normals[:8] * diagonal).sum(-1) > 0.9).all()
    assert torch.equal(normals[8], torch.zeros(3, dtype=torch.float64))


def test_the_uv_gradient_of_an_affine_map_is_its_matrix():
    """P = A (u, v) on random triangles that are not mirrored: the columns of A come back."""
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(30, 2, dtype=torch.float64, generator=generator)
    affine = torch.randn(2, 3, dtype=torch.float64, generator=generator)
    faces = torch.arange(30).reshape(10, 3)
    (u0, v0), (u1, v1), (u2, v2) = (uv[faces[:, k]].unbind(-1) for k in range(3))
    mirrored = (u1 - u0) * (v2 - v0) < (u2 - u0) * (v1 - v0)
    faces = torch.where(mirrored[:, None], faces.flip(1), faces)
    du, dv = uv_gradient(uv, faces)
    corners = (uv @ affine)[faces]
    assert torch.allclose((du[..., None] * corners).sum(1), affine[0].expand(10, 3))
    assert torch.allclose((dv[..., None] * corners).sum(1), affine[1].expand(10, 3))


@pytest.mark.parametrize(
    "uv",
    [
        pytest.param([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], id="as painted"),
        pytest.param([[1.0, 0.0], [0.0, 0.0], [1.0, 1.0]], id="mirrored"),
        pytest.param([[0.3, 0.3], [0.3, 0.3], [0.3, 0.3]], id="a point"),
        pytest.param([[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]], id="a line"),
    ],
)
def test_du_cross_dv_follows_the_face_normal_whatever_the_chart(uv):
    corners = torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.3, 1.5], [0.1, 1.0, 0.7]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2]])
    du, dv = (weights[0] @ corners for weights in uv_gradient(torch.tensor(uv, dtype=torch.float64), faces))
    normal = torch.nn.functional.normalize(torch.linalg.cross(du, dv), dim=0)
    assert torch.allclose(normal, torch.nn.functional.normalize(face_cross(corners, faces)[0], dim=0))


def test_normals_of_vertices_are_those_of_trimesh_and_zero_without_faces():
    draws = np.random.default_rng(0)
    vertices, faces = draws.normal(size=(9, 3)), draws.permuted(np.tile(np.arange(8), (12, 1)), axis=1)[:, :3]
    faces[0] = faces[0, 0]
    normals = textured_mesh.vertex_normals(vertices, faces)
    crosses = trimesh.triangles.cross(vertices[faces])
    assert np.allclose(normals, trimesh.geometry.mean_vertex_normals(len(vertices), faces, crosses), atol=1e-12)
    assert not normals[8].any()
