import pytest
import torch
from primdiffusion.body.model import betas_of_measures, measure
from primdiffusion.body.model import default_body as load_default_body
from support.errors import refused


@pytest.fixture(scope="module")
def default_body():
    return load_default_body()


def test_a_person_is_as_tall_as_their_vertices_and_as_heavy_as_their_volume(default_body):
    import trimesh

    shape = default_body.shape(torch.tensor([0.5, -1.0, 0.3]))
    mesh = trimesh.Trimesh(shape.vertices.numpy(), default_body.faces.numpy(), process=False)
    height, weight = measure(shape)
    assert height == pytest.approx(mesh.extents[1], abs=1e-5)
    assert weight == pytest.approx(985 * mesh.volume, rel=1e-4)
    assert 1.5 < height < 2.1
    assert 40 < weight < 120


@pytest.mark.parametrize(("height", "weight"), [(1.6, None), (None, 80.0), (1.9, 95.0), (None, None)])
def test_bodies_of_given_measures_have_them(default_body, height, weight):
    betas = torch.linspace(-1, 1, 10)
    moved = betas_of_measures(betas, torch.eye(10), default_body, height, weight)
    measured = measure(default_body.shape(moved))
    assert height is None or measured.height == pytest.approx(height, abs=2e-4)
    assert weight is None or measured.weight == pytest.approx(weight, abs=2e-2)
    assert (moved - betas).norm() < 5


def test_a_change_follows_the_shapes_that_people_have(default_body):
    # where only the first two betas vary, only they give way
    scale = torch.diag(torch.tensor([1.0, 1.0, *[0.0] * 8]))
    moved = betas_of_measures(torch.zeros(10), scale, default_body, height=1.8, weight=75.0)
    assert torch.equal(moved[2:], torch.zeros(8))
    assert (moved[:2] != 0).all()


def test_bodies_that_no_human_has_are_rejected(default_body):
    with refused(ValueError, "2.60", "30 kg"):
        betas_of_measures(torch.zeros(10), torch.eye(10), default_body, 2.6, 30.0)
