import dataclasses
import json

import pytest
import torch
from diffusion_people import small_model
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.model import STANDARD_SHAPES, sample, seeded_generator
from primdiffusion.diffusion.schedule import trailing_steps
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.tensor_file import read, save
from primdiffusion.human import generate, generate_batch
from primdiffusion.primitives.primitives import GRID, K, S
from support.errors import refused
from support.tiny import save_tiny_checkpoint


@pytest.fixture(scope="module")
def model():
    return small_model()


def result(*arguments, **settings):
    *_, step = sample(*arguments, **settings)
    return step.x0


@pytest.mark.parametrize("sampler", ["ddim", "ddpm", "dpmpp_2m"])
def test_sampling_yields_every_step_down_to_a_clean_person(model, sampler):
    steps = list(sample(model, [0], 6, sampler))
    assert [(s.index, s.total, s.t) for s in steps] == [(i, 6, t) for i, t in enumerate(trailing_steps(1000, 6))]
    assert torch.equal(steps[-1].x, steps[-1].x0)
    assert steps[-1].x0.isfinite().all()


def test_a_start_without_the_prior_loses_variety():
    # a few strong components still show at T-1: noise alone stands for a person without them
    model = small_model(scale=300.0)
    last = 999
    start = model.start([seeded_generator(seed) for seed in range(400)], last)
    prior = model.denoiser.prior
    y = prior.split(start, torch.tensor(model.schedule.signal(last)))[0]
    expected = model.schedule.signal(last) ** 2 * prior.marginal_variance() + model.schedule.noise(last) ** 2
    assert torch.allclose(y.var(0), expected, rtol=0.25)
    assert expected.max() > 2


def test_decoding_gives_a_valid_payload(model):
    payload = model.decode(40 * torch.randn(2, 4, GRID, GRID)).validate()
    assert payload.rgb.shape == (2, K, 3, S, S, S)
    assert payload.rgb.min() >= 0
    assert payload.rgb.max() <= 1
    assert payload.density.min() >= 0
    assert payload.density.max() <= model.full_density
    assert torch.equal(payload.delta_scale, torch.ones(2, K, 3))


def test_shapes_follow_the_person_and_the_seed_within_limits(model):
    x0 = result(model, [3, 4], 3)
    betas = model.betas(x0, [7, 7])
    assert betas.shape == (2, 10)
    assert torch.equal(betas, model.betas(x0, [7, 7]))
    assert torch.allclose(betas[1:], model.betas(x0[1:], [7]), atol=1e-5)
    assert not torch.equal(betas, model.betas(x0, [8, 7]))
    assert betas.abs().max() <= 2.5
    assert not torch.allclose(betas, model.betas(-x0, [7, 7]))


def test_shapes_without_knowledge_are_standard_normal():
    betas = STANDARD_SHAPES.sample(torch.zeros(20_000, 0), seeded_generator(0))
    assert betas.mean(0).abs().max() < 0.05
    assert (betas.std(0) - 1).abs().max() < 0.05


def test_sampling_does_not_disturb_the_global_random_state(model):
    before = torch.get_rng_state()
    result(model, [1], 2)
    assert torch.equal(before, torch.get_rng_state())


def test_results_are_ordinary_tensors(model):
    # inference tensors would make a user's own optimisation of a person fail
    x0 = result(model, [1], 2)
    assert not model.decode(x0).rgb.is_inference()


@pytest.mark.parametrize("sampler", ["ddim", "ddpm", "dpmpp_2m"])
def test_people_are_the_same_in_any_company(model, sampler):
    together = result(model, [5, 6, 7], 4, sampler)
    assert torch.allclose(together[1:2], result(model, [6], 4, sampler), atol=1e-4)


@pytest.mark.slow
def test_company_changes_no_value_by_more_than_rounding():
    shipped = load_checkpoint(None)
    alone, in_company = generate_batch(shipped, [3])[0], generate_batch(shipped, list(range(8)))[3]
    for name in ("rgb", "density"):
        one, other = getattr(alone.payload, name), getattr(in_company.payload, name)
        assert (one - other).abs().max() < 1e-5 * (one.max() - one.min())


def test_guidance_extrapolates_person_components_and_the_rest_follows_from_them(model):
    x, condition = torch.randn(2, 4, GRID, GRID), model.condition({"outfit": "suit"})
    denoiser = model.denoiser
    y, rest = denoiser.prior.split(x, torch.tensor(model.schedule.signal(600)))
    t, conditions = torch.full((2,), 600), condition.expand(2, -1)
    with torch.inference_mode():
        unconditional, conditional = denoiser.coefficients(y, t), denoiser.coefficients(y, t, conditions)
        guided = 2 * conditional - unconditional
        expected = denoiser.prior.join(guided, denoiser.rest(rest, guided, t, conditions))
    assert (conditional - unconditional).abs().max() > 0.01
    assert torch.allclose(model.denoise(x, 600, condition, 2.0), expected, atol=1e-4)
    assert model.condition({}) is None


def test_categories_that_nobody_asked_for_are_drawn_and_those_asked_for_stay(model):
    suit = model.condition({"outfit": "suit"})
    generators = [seeded_generator(seed) for seed in range(40)]
    anything = model.complete(generators, None)
    assert anything.shape == (40, model.vocabulary.width)
    assert (anything.sum(1) == 1).all()
    assert 0 < anything[:, 0].mean() < 1
    assert torch.equal(model.complete(generators, suit[None]), suit.expand(40, -1))
    again = [model.complete([seeded_generator(seed)])[0] for seed in range(40)]
    assert torch.equal(torch.stack(again), anything)


def test_asking_draws_the_start_from_those_who_have_it(model):
    condition = model.condition({"outfit": "suit"})
    starts = model.start([seeded_generator(seed) for seed in range(300)], 0, condition)
    c = model.denoiser.prior.split(starts)[0]
    assert torch.allclose(c.mean(0), model.denoiser.prior.centre[0, 1], atol=1.0)
    with refused(ValueError, "jeans"):
        model.condition({"outfit": "robe"})


def test_encoding_is_the_inverse_of_decoding(model):
    x0 = 0.5 * torch.randn(2, 4, GRID, GRID)
    assert torch.allclose(model.encode(model.decode(x0)), x0, atol=0.05)


def test_a_region_s_mask_covers_its_primitives(model):
    region = torch.zeros(K, dtype=torch.bool)
    region[[0, 33]] = True
    assert model.cell_mask(region).nonzero().tolist() == [[0, 0], [1, 1]]
    slab = dataclasses.replace(model, codec=WholeSlab()).cell_mask(region)
    assert slab.shape == (GRID * S, GRID * S)
    assert slab.sum() == 2 * S * S
    assert slab[8:16, 8:16].all()
    with refused(ValueError, "1024"):
        model.cell_mask(region[:7])


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    return read(save_tiny_checkpoint(tmp_path_factory.mktemp("whole") / "whole.safetensors"))


def load_with(content, path, **changed):
    tensors, metadata = content
    path.write_bytes(save(tensors | changed, metadata))
    return load_checkpoint(path)


def other_shapes(value):
    """The tensor one shorter and twice as long along each axis, flat, with an axis more, and empty."""
    for axis in range(value.ndim):
        if value.shape[axis] > 1:
            yield value.narrow(axis, 0, value.shape[axis] - 1).contiguous()
        yield torch.cat([value, value], axis)
    yield from (value.flatten()[:1].clone(), value[None].clone(), value.flatten()[:0].clone())


def test_what_loads_generates_and_what_does_not_fit_does_not_load(content, tmp_path):
    rejected = 0
    for name, value in content[0].items():
        for changed in other_shapes(value):
            fewer_channels = name == "denoiser.prior_basis_half" and changed.shape == (3, 3, 32, 16)  # is possible
            if changed.shape == value.shape or fewer_channels:
                continue
            with refused(FileError):
                load_with(content, tmp_path / "a.safetensors", **{name: changed})
            rejected += 1
    assert rejected > 60
    generate(load_with(content, tmp_path / "a.safetensors"), 1, 1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("denoiser.prior_variance", torch.full((1, 3), -1.0)),
        ("denoiser.prior_basis_half", torch.full((3, 4, 32, 16), 6.0)),
        ("codec.weight", torch.zeros(2051)),
        ("shapes.limit", torch.full((10,), 1e6)),
    ],
)
def test_values_that_make_no_human_are_rejected(content, tmp_path, name, value):
    with refused(FileError):
        load_with(content, tmp_path / "a.safetensors", **{name: value})


def test_a_vocabulary_of_another_width_is_rejected(content, tmp_path):
    tensors, metadata = content
    architecture = json.loads(metadata["architecture"])
    architecture["vocabulary"]["scalars"] = {}
    changed = tensors, metadata | {"architecture": json.dumps(architecture)}
    with refused(FileError, "6 values"):
        load_with(changed, tmp_path / "a.safetensors")
