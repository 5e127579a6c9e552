"""Edits of people: what they change, what they leave as it is to the last bit, what they say of themselves."""

import dataclasses
import itertools
import json

import pytest
import torch
from diffusion_people import small_model
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.model import DiffusionModel, seeded_generator
from primdiffusion.diffusion.schedule import early_steps, linear, trailing_steps
from primdiffusion.editing.edit import edit_generator, edit_timesteps, encode_human
from primdiffusion.editing.inpaint import harmonise, inpaint
from primdiffusion.editing.interpolate import interpolate, inversion_steps, invert, slerp
from primdiffusion.editing.regions import region_of
from primdiffusion.editing.transfer import transfer_garment, transfer_texture
from primdiffusion.editing.vary import vary
from primdiffusion.human import generate
from primdiffusion.human_file import load_human, save_human
from primdiffusion.primitives.body_setup import BodyFiles, BodySetup, FileFingerprint
from support.errors import refused
from support.tiny import model_of_two_kinds, random_human, slab_model, tiny_model

FIELDS = ("rgb", "density", "delta_scale")
TOP = region_of(["top"])


@pytest.fixture(scope="module", params=["cells", "slab"])
def model(request):
    """The default kind of model with small networks, and the paper's kind."""
    return small_model() if request.param == "cells" else slab_model()


@pytest.fixture(scope="module")
def human():
    return random_human(1)


@pytest.fixture(scope="module")
def other():
    return random_human(2)


def same(one, two, where=slice(None)) -> bool:
    return all(torch.equal(getattr(one.payload, name)[where], getattr(two.payload, name)[where]) for name in FIELDS)


def distance(one, two) -> float:
    return float((one.payload.rgb - two.payload.rgb).square().mean().sqrt())


EDITS = {
    "vary": lambda model, human, **more: vary(model, human, **{"amount": 0.6, "steps": 2, **more}),
    "inpaint": lambda model, human, **more: inpaint(model, human, TOP, **{"steps": 2, **more}),
    "inpaint_released": lambda model, human, **more: inpaint(
        model, human, TOP, **{"steps": 2, "masking": "released", **more}
    ),
    "harmonise": lambda model, human, **more: harmonise(model, human, TOP, **{"amount": 0.6, "steps": 2, **more}),
}


@pytest.mark.parametrize("name", ["inpaint", "inpaint_released", "harmonise"])
def test_outside_the_region_nothing_changes_by_a_bit(model, human, name):
    edited = EDITS[name](model, human)
    assert same(edited, human, ~TOP)
    assert torch.equal(edited.betas, human.betas)
    assert not torch.isclose(edited.payload.rgb[TOP], human.payload.rgb[TOP]).flatten(1).all(1).any()


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_is_its_seeds_own(human, name):
    model = small_model()
    first = EDITS[name](model, human, seed=3)
    assert same(first, EDITS[name](model, human, seed=3))
    assert not same(first, EDITS[name](model, human, seed=4))


def test_the_seed_that_made_a_person_does_not_lead_an_edit_back_to_them():
    model = tiny_model()
    person = generate(model, 5, steps=4)
    moved = [distance(vary(model, person, 1.0, seed, steps=4), person) for seed in (5, 6, 7)]
    assert moved[0] > 0.3 * max(moved)
    noises = [torch.randn(4, generator=make(5)) for make in (seeded_generator, edit_generator)]
    assert not torch.isclose(*noises).any()


@pytest.mark.parametrize("edit", [vary, lambda *people, **more: harmonise(*people, TOP, **more)])
def test_an_amount_of_0_is_the_person_themselves(human, edit):
    assert same(edit(small_model(), human, amount=0.0), human)


def test_a_variant_is_farther_the_larger_the_amount_and_near_for_a_small_one(human):
    model = tiny_model()
    distances = [distance(vary(model, human, amount, seed=1), human) for amount in (0.003, 0.1, 0.5, 0.9)]
    assert distances[0] < 0.01
    assert distances == sorted(distances)


def test_a_variant_keeps_the_body(human):
    assert torch.equal(vary(small_model(), human, 0.9, steps=2).betas, human.betas)


def test_edits_go_down_from_the_level_of_their_amount():
    model = dataclasses.replace(tiny_model(), schedule=linear(), chain=trailing_steps)
    assert edit_timesteps(model, 1.0, 4) == [999, 749, 499, 249]
    assert edit_timesteps(model, 0.0, 4) == []
    assert edit_timesteps(model, 0.5, 1) == [round(1000 * 0.5**0.7) - 1]
    assert edit_timesteps(model, 0.0004, 30) == [3, 2, 1, 0]


@pytest.mark.parametrize("amount", [0.05, 0.25, 0.9])
def test_edits_end_where_sampling_ends(amount):
    model = dataclasses.replace(tiny_model(), schedule=linear(), chain=early_steps)
    assert edit_timesteps(model, amount, 10)[-1] == min(50, round(1000 * amount**0.7) - 10)
    trailing = dataclasses.replace(model, chain=trailing_steps)
    assert edit_timesteps(trailing, amount, 10)[-1] == min(99, round(1000 * amount**0.7) - 10)


@pytest.mark.parametrize(
    ("wrong", "fact"),
    [
        ({"steps": 0}, "1 to 1000; 0 "),
        ({"steps": 1001}, "1 to 1000; 1001 "),
        ({"seed": -1}, "seed -1 is out of range"),
        ({"seed": 2**63}, "out of range"),
    ],
)
@pytest.mark.parametrize("name", EDITS)
def test_steps_and_seeds_out_of_range_are_rejected_before_any_work(human, name, wrong, fact):
    with refused(ValueError, fact):
        EDITS[name](model_that_must_not_work(), human, **wrong)


def model_that_must_not_work():
    """Its denoiser must not be reached."""
    model = small_model()

    def denoise(*_):
        raise AssertionError("work was done")

    model.denoiser.forward = denoise
    return model


def test_masked_sampling_has_two_modes_and_the_file_says_which(human):
    model = small_model()
    for masking in ("repaint", "released"):
        edited = inpaint(model, human, TOP, steps=2, masking=masking)
        assert edited.provenance["edits"][-1]["masking"] == masking
    with refused(ValueError, "masking", "none", "repaint", "released"):
        inpaint(model_that_must_not_work(), human, TOP, masking="none")


@pytest.mark.parametrize("amount", [-0.1, 1.1, float("nan")])
def test_an_amount_outside_0_to_1_is_rejected(human, amount):
    with refused(ValueError, "0 to 1"):
        vary(model_that_must_not_work(), human, amount)
    with refused(ValueError, "0 to 1"):
        harmonise(model_that_must_not_work(), human, TOP, amount)


@pytest.mark.parametrize("edit", ["vary", "inpaint"])
def test_what_the_model_does_not_know_cannot_be_asked_for(human, edit):
    with refused(ValueError, "species"):
        EDITS[edit](tiny_model(), human, attributes={"species": "cat"})
    with refused(ValueError, "guidance"):
        EDITS[edit](tiny_model(), human, guidance=float("nan"))


@pytest.mark.parametrize("edit", ["vary", "harmonise"])
def test_plain_clothes_that_the_prior_takes_for_patterned_stay_plain(human, edit, monkeypatch):
    model, asked = small_model(), []
    from_picture = dataclasses.replace(human, provenance={**human.provenance, "reconstructed_from": "anna"})
    monkeypatch.setattr(DiffusionModel, "condition", lambda self, attributes: asked.append(dict(attributes)))
    for plain in (False, True):
        monkeypatch.setattr(DiffusionModel, "plain_after_all", lambda *_, plain=plain: plain)
        EDITS[edit](model, from_picture)
        assert asked[-1] == ({"pattern": "plain"} if plain else {})
    EDITS[edit](model, human)
    assert asked[-1] == {}
    vary(model, from_picture, 0.6, steps=2, attributes={"pattern": "patterned"})
    assert asked[-1] == {"pattern": "patterned"}


def test_attributes_steer_what_a_region_becomes(human):
    model = tiny_model()
    name, values = next(iter(model.vocabulary.categories.items()))
    wearing = [inpaint(model, human, TOP, steps=4, attributes={name: value}, guidance=3.0) for value in values[:2]]
    assert not same(*wearing)
    assert same(*wearing, ~TOP)
    assert wearing[1].provenance["edits"][0]["attributes"] == {name: values[1]}


def test_a_person_of_another_density_scale_stays_as_dense(human):
    thin = dataclasses.replace(human.payload, density=human.payload.density / 4)
    thin = dataclasses.replace(human, payload=thin, provenance={"full_density": 25.0})
    model = small_model()
    edited, thin_edited = (inpaint(model, person, TOP, steps=2) for person in (human, thin))
    assert torch.allclose(thin_edited.payload.density, edited.payload.density / 4, atol=1e-3)


@pytest.mark.parametrize("density", [0.0, -3.0, "solid", float("nan"), True])
def test_a_density_scale_that_is_none_is_rejected(human, density):
    odd = dataclasses.replace(human, provenance={"full_density": density})
    with refused(ValueError, "full_density"):
        vary(small_model(), odd)


# transfer


def test_a_texture_is_the_sources_colours_on_the_targets_shape(human, other):
    edited = transfer_texture(other, human, TOP)
    assert torch.equal(edited.payload.rgb[TOP], other.payload.rgb[TOP])
    assert torch.equal(edited.payload.rgb[~TOP], human.payload.rgb[~TOP])
    assert torch.equal(edited.payload.density, human.payload.density)
    assert torch.equal(edited.payload.delta_scale, human.payload.delta_scale)
    assert torch.equal(edited.betas, human.betas)


def test_a_garment_comes_with_its_shape_and_sits_on_the_targets_body(human, other):
    edited = transfer_garment(other, human, TOP)
    assert same(edited, other, TOP)
    assert same(edited, human, ~TOP)
    assert torch.equal(edited.betas, human.betas)


def test_people_on_different_bodies_do_not_correspond(human, other):
    body_setup = BodySetup(None, None, BodyFiles(FileFingerprint("smpl.npz", "12"), ()))
    foreign = dataclasses.replace(other, body_setup=body_setup)
    for edit in (
        lambda: transfer_texture(foreign, human, TOP),
        lambda: transfer_garment(human, foreign, TOP),
        lambda: vary(small_model(), foreign),
        lambda: interpolate(small_model(), human, foreign),
    ):
        with refused(ValueError, "bodies"):
            edit()


# interpolate


@pytest.mark.parametrize(("fraction", "end"), [(0.0, 0), (1.0, 1)])
def test_the_ends_of_an_interpolation_are_the_people_themselves(human, other, fraction, end):
    edited = interpolate(small_model(), human, other, fraction, steps=4)
    assert same(edited, (human, other)[end])
    assert torch.equal(edited.betas, (human, other)[end].betas)


def test_an_interpolation_leaves_its_ends_without_a_jump(human, other):
    for fraction, end in ((1e-4, human), (1 - 1e-4, other)):
        edited = interpolate(small_model(), human, other, fraction, steps=3)
        assert distance(edited, end) < 2e-3
        assert distance(edited, end) < 0.01 * distance(human, other)


def test_what_lies_between_has_the_attributes_of_the_nearer_end(monkeypatch):
    model, conditions, denoise = model_of_two_kinds(), [], DiffusionModel.denoise
    kinds, decode = [], DiffusionModel.decode
    ends = [generate(model, 0, 3, attributes={"sex": sex}) for sex in ("female", "male")]

    def noted(self, x, t, condition=None, guidance=1.0):
        conditions.append(condition)
        return denoise(self, x, t, condition, guidance)

    monkeypatch.setattr(DiffusionModel, "denoise", noted)
    monkeypatch.setattr(DiffusionModel, "decode", lambda self, x0, kind=None: kinds.append(kind) or decode(self, x0))
    for fraction, nearer in ((0.4, "jeans"), (0.6, "suit")):
        interpolate(model, *ends, fraction, steps=3)
        worn = [model.vocabulary.encode({"outfit": outfit}) for outfit in ("jeans", "suit", nearer)]
        assert torch.stack([row @ outfit for row, outfit in zip(conditions[-1], worn, strict=True)]).min() > 0.99
        assert kinds[-3][0] @ worn[-1] > 0.99  # then both ends are decoded, to see what was lost


def test_clothes_of_one_colour_are_read_as_plain(monkeypatch):
    words = AttributeVocabulary({"sex": ("female", "male"), "pattern": ("patterned", "plain")}, {})
    model = dataclasses.replace(model_of_two_kinds(), vocabulary=words)
    woman = encode_human(model, generate(model, 0, 3, attributes={"sex": "female"}))
    for even, pattern in ((False, "patterned"), (True, "plain")):
        monkeypatch.setattr(DiffusionModel, "plain_after_all", lambda *_, even=even: even)
        assert model.read_condition(woman)[0] @ words.encode({"pattern": pattern}) > 0.99


def test_betas_are_interpolated_linearly(human, other):
    edited = interpolate(small_model(), human, other, 0.25, steps=3)
    assert torch.allclose(edited.betas, 0.75 * human.betas + 0.25 * other.betas)


def test_an_interpolation_is_the_same_from_either_end(human, other):
    one = interpolate(small_model(), human, other, 0.25, steps=4)
    two = interpolate(small_model(), other, human, 0.75, steps=4)
    assert torch.allclose(one.payload.rgb, two.payload.rgb, atol=1e-4)
    assert one.provenance["edits"][0] == two.provenance["edits"][0]


def test_ddim_backwards_and_forwards_returns_the_nearer_the_more_steps():
    model = tiny_model()
    x0 = model.denoiser.prior.sample(1, torch.Generator().manual_seed(0))
    from primdiffusion.diffusion.samplers import ddim

    def loss(steps):
        chain = inversion_steps(model.schedule, steps)
        *_, up = invert(model.denoise, model.schedule, x0, chain)
        *_, down = ddim(model.denoise, model.schedule, up.x, chain, [])
        return float((down.x0 - x0).norm() / x0.norm())

    losses = [loss(steps) for steps in (10, 40, 160)]
    assert losses[0] > losses[1] > losses[2]
    assert losses[2] < 0.05


def test_the_arc_keeps_the_distance_from_the_middle():
    a, b = torch.tensor([[[1.0, 0.0]]]), torch.tensor([[[0.0, 1.0]]])
    for fraction, expected in ((0.0, a), (1.0, b), (0.5, torch.full((1, 1, 2), 0.5**0.5))):
        assert torch.allclose(slerp(a, b, fraction), expected, atol=1e-6)
    assert torch.allclose(slerp(a, a, 0.3), a)
    assert torch.allclose(slerp(a, -a, 0.25), 0.5 * a), "opposite ends have no one arc"


@pytest.mark.parametrize(
    ("wrong", "fact"),
    [({"fraction": 1.5}, "fraction is 1.5"), ({"steps": 1}, "2 to 1000"), ({"steps": 1001}, "2 to 1000")],
)
def test_an_interpolation_out_of_range_is_rejected(human, other, wrong, fact):
    with refused(ValueError, fact):
        interpolate(model_that_must_not_work(), human, other, **wrong)


def test_people_of_different_density_scales_are_not_interpolated(human, other):
    thin = dataclasses.replace(other, provenance={"full_density": 25.5})
    with refused(ValueError, "100", "25.5"):
        interpolate(small_model(), human, thin)


# all


def test_steps_are_counted_to_their_total_and_can_be_stopped_at_each(human, other):
    edits = {
        **{
            name: lambda on_step, edit=edit: edit(small_model(), human, on_step=on_step) for name, edit in EDITS.items()
        },
        "interpolate": lambda on_step: interpolate(small_model(), human, other, steps=3, on_step=on_step),
    }

    class Stop(Exception):
        pass

    for name, edit in edits.items():
        steps = []
        edit(on_step=steps.append)
        assert [step.index for step in steps] == list(range(steps[0].total)), name

        for end in range(len(steps)):
            count = itertools.count()

            def stop(_, count=count, end=end):
                if next(count) == end:
                    raise Stop

            with pytest.raises(Stop):
                edit(on_step=stop)


def test_what_was_done_is_kept_in_order_and_in_files(human, other, tmp_path):
    model = small_model()
    edited = vary(model, human, 0.3, seed=9, steps=2)
    edited = transfer_texture(other, edited, region_of(["hair"]))
    edited = inpaint(model, edited, region_of(["shoes"]), steps=1)
    save_human(tmp_path / "edited.human.safetensors", edited)
    edits = load_human(tmp_path / "edited.human.safetensors").provenance["edits"]
    assert [edit["edit"] for edit in edits] == ["vary", "transfer_texture", "inpaint"]
    assert (edits[0]["amount"], edits[0]["seed"]) == (0.3, 9)
    assert edits[1]["region"] == ["hair"]
    assert edits[1]["source"]["seed"] == 2
    assert edits[2]["checkpoint"] == "small"
    assert edited.provenance["seed"] == 1, "the person's own"
    json.dumps(edits)
