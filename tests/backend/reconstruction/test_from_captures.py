"""Reconstruction by the prior, of people of a tiny model whose garments have one colour all over."""

import dataclasses

import numpy as np
import pytest
import torch
from primdiffusion.body.model import BodyPose
from primdiffusion.capture.conditioning import CapturedPerson
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.reader import Views
from primdiffusion.diffusion.model import sample
from primdiffusion.diffusion.surfaces import Surfaces, optional_fields
from primdiffusion.encoder.model import EncoderModel
from primdiffusion.encoder.network import Encoder
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, frames_of, framing, place
from primdiffusion.primitives.primitives import Payload, Primitives, S
from primdiffusion.reconstruction import from_captures
from primdiffusion.reconstruction.from_captures import HUMAN_STEPS, draw_humans, encode_and_fit, reconstruct, steps_of
from primdiffusion.reconstruction.prior_fit import OBSERVATIONS, PIXEL_STD, PriorFit, targets_of
from primdiffusion.render.descent import DescentSettings, descend
from primdiffusion.render.inverse import InverseSettings, LinearisedView
from primdiffusion.render.march import march
from scipy.stats import multivariate_normal
from support.errors import refused
from support.priors import of_whole_body
from support.tiny import SLOW, TINY, tiny_encoder, tiny_model

MODEL = tiny_model()
PRIOR = MODEL.denoiser.prior
BETAS = torch.linspace(-0.5, 0.5, 10)
COLOURS = torch.tensor([30.0, -20.0, 5.0])


def human_of(coefficients: torch.Tensor) -> Human:
    latents = (PRIOR.mean + PRIOR.picture(coefficients[None]))[0]
    return Human(MODEL.decode(latents).map(torch.Tensor.clone), BETAS, {})


def captured(human: Human, pose: BodyPose, yaws: list[float]) -> CapturedPerson:
    primitives = place(human, pose)
    cameras = [framing(primitives, yaw, 96, 128) for yaw in yaws]
    pictures = []
    for camera in cameras:
        seen = march(primitives, camera)
        rgba = torch.cat([encode_srgb(seen.rgb.clamp(0, 1)), seen.alpha[..., None]], -1)
        pictures.append((255 * rgba).round().to(torch.uint8))
    views = Views(torch.stack(pictures), stack(cameras), pose)
    return CapturedPerson("anna", 3, tuple(range(len(yaws))), views, BETAS, ())


@pytest.fixture(scope="module")
def plain() -> tuple[CapturedPerson, Human, int]:
    """A person in one view, what is made of it, and the number of steps."""
    person, steps = captured(human_of(COLOURS), BodyPose.rest(), [0.0]), []
    return person, reconstruct(MODEL, person, on_step=lambda: steps.append(None)), len(steps)


@pytest.mark.parametrize("yaws", [[0.0], [0.0, 90.0]], ids=["one view", "two views"])
def test_what_no_view_shows_has_the_most_probable_colours_given_what_they_show(yaws):
    human, pose = human_of(COLOURS), BodyPose.from_axis_angle(torch.linspace(-0.2, 0.2, 72))
    found = reconstruct(MODEL, captured(human, pose, yaws))
    wanted, got, mean = (encode_srgb(one.payload.rgb) for one in (human, found, human_of(torch.zeros(3))))
    assert (mean - wanted).abs().mean() > 0.03
    assert (got - wanted).abs().mean() < 0.006
    assert (got - wanted).abs().flatten(1).mean(1).max() < 0.02
    assert torch.equal(found.betas, BETAS)
    assert (found.provenance["reconstructed_from"], found.provenance["views"]) == ("anna", list(range(len(yaws))))


def test_unseen_sides_have_surfaces_of_one_colour(plain):
    depth = place(human_of(COLOURS), BodyPose.rest()).position[:, 2]
    front, back = depth.argmax()[None], depth.argmin()[None]
    ones = torch.ones(2, S**3)
    surfaces = Surfaces(
        torch.zeros(1, MODEL.vocabulary.width), torch.tensor([False]), torch.zeros(2, dtype=torch.int64),
        torch.cat([front, back]), ones,
        torch.stack([ones[0], 0.5 * ones[0]]), torch.tensor([True, False]), torch.tensor([False, True]),
        *(torch.zeros(0, dtype=torch.int64),) * 3, ones[:0], **optional_fields(),
    )  # fmt: skip
    person, free, _ = plain
    found = reconstruct(dataclasses.replace(MODEL, surfaces=surfaces), person)
    before, after = (encode_srgb(human.payload.rgb[back]) for human in (free, found))
    torch.testing.assert_close(after, 0.5 * before, atol=0.02, rtol=0)


def test_hair_on_the_back_has_the_colour_that_the_picture_shows_in_front():
    human = human_of(COLOURS)
    primitives = place(human, BodyPose.rest())
    head = (primitives.position[:, 1] > primitives.position[:, 1].max() - 0.3).nonzero()[:, 0]
    rgb = human.payload.rgb.clone()
    rgb[head] *= torch.tensor([1.0, 0.4, 0.2]).view(3, 1, 1, 1)
    person = captured(
        dataclasses.replace(human, payload=dataclasses.replace(human.payload, rgb=rgb)), BodyPose.rest(), [0.0]
    )
    ones, yes = torch.ones(len(head), S**3), torch.ones(len(head), dtype=torch.bool)
    hair = Surfaces(
        torch.zeros(1, MODEL.vocabulary.width), torch.tensor([True]), torch.zeros(len(head), dtype=torch.int64),
        head, ones, ones, yes, yes, *(torch.zeros(0, dtype=torch.int64),) * 3, ones[:0], **optional_fields(),
    )  # fmt: skip
    behind = head[primitives.position[head, 2] < primitives.position[head, 2].median() - 0.05]
    errors = []
    for natural in (True, False):  # a garment keeps the colour that the person components give it
        surfaces = dataclasses.replace(hair, natural=torch.tensor([natural]))
        found = reconstruct(dataclasses.replace(MODEL, surfaces=surfaces), person).payload
        errors.append(float((encode_srgb(found.rgb[behind]) - encode_srgb(rgb[behind])).abs().mean()))
    assert errors[0] < 0.03 < 0.1 < errors[1]


def test_the_more_views_the_nearer_the_human_is_to_what_they_show():
    human = human_of(COLOURS)
    noise = torch.rand(human.payload.rgb.shape, generator=torch.Generator().manual_seed(0))
    noisy = dataclasses.replace(human, payload=dataclasses.replace(human.payload, rgb=noise))
    errors = []
    for count in (1, 4):  # the same view again: it tells nothing new
        person = captured(noisy, BodyPose.rest(), [0.0] * count)
        found = reconstruct(MODEL, person)
        target = targets_of(person.views, [frames_of(found)] * count, 128)[0]
        drawn = march(place(found), target.camera).rgb
        errors.append(float((encode_srgb(drawn) - encode_srgb(target.rgba[..., :3])).abs().mean()))
    assert errors[1] < 0.85 * errors[0]


def test_smaller_pictures_are_what_their_cameras_see():
    human = human_of(COLOURS)
    person = captured(human, BodyPose.rest(), [0.3])
    for largest, size in ((128, (128, 96)), (64, (64, 48)), (50, (42, 32))):
        (target,) = targets_of(person.views, [frames_of(human)], largest)
        seen = march(place(human), target.camera)
        drawn = torch.cat([seen.rgb, seen.alpha[..., None]], -1)
        assert (target.camera.height, target.camera.width) == drawn.shape[:2] == size
        assert (drawn - target.rgba).abs().mean() < 0.012


def test_every_step_is_reported_and_an_exception_cancels(plain):
    person, _, steps = plain
    assert steps == steps_of(MODEL) > HUMAN_STEPS
    assert steps_of(tiny_encoder()) == 0

    def cancel() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(MODEL, person, on_step=cancel)


def test_an_outfit_is_found_that_steps_from_the_mean_human_do_not_reach():
    # the mean human is so bright that its colours are clipped: no picture tells which way they should go
    white = torch.zeros_like(PRIOR.mean)
    white[:3] = 150 / 32
    prior = of_whole_body(
        mean=white,
        basis=PRIOR.basis.mT.flatten(1),
        parity=PRIOR.parity,
        rest_variance=PRIOR.rest_variance,
        log_weight=torch.tensor([[0.8], [0.2]]).log(),
        centre=torch.tensor([30.0, -150.0])[:, None, None].repeat(1, 1, 3),
        axes=PRIOR.axes.repeat(2, 1, 1),
        variance=torch.full((2, 3), 12.0**2),
        kind=PRIOR.kind.transpose(0, 1),
    )
    components = dataclasses.replace(PriorFit.of(MODEL), prior=prior)
    wanted = torch.tensor([-140.0, -155.0, -150.0])
    human = Human(components.payload(wanted), BETAS, {})
    person = captured(human, BodyPose.rest(), [0.0])
    frames = [frames_of(human)]
    from_mean = components.everyone()
    for _ in range(4):
        from_mean = components.gauss_newton_step(from_mean, targets_of(person.views, frames, 64))
    assert (components.coefficients(from_mean) - wanted).norm() > 100
    assert (components.coefficients(components.start(person.views, frames)) - wanted).norm() < 10


def test_evidence_is_the_pictures_probability_where_the_prior_leaves_no_choice():
    prior = dataclasses.replace(PRIOR, centre=torch.zeros(1, 2, 3), variance=torch.full((1, 3), 1e-8))
    components = dataclasses.replace(PriorFit.of(MODEL), prior=prior)
    human = human_of(COLOURS)
    targets = targets_of(captured(human, BodyPose.rest(), [0.0]).views, [frames_of(human)], 64)
    everyone = components.everyone()
    mean_human = components.payload(components.coefficients(everyone))
    view = LinearisedView.of(targets[0], mean_human, InverseSettings())
    wanted = -OBSERVATIONS / PIXEL_STD**2 * float((view.weight * view.residual**2).sum()) / 2
    assert components.gauss_newton_step(everyone, targets).evidence == pytest.approx(wanted, rel=1e-3)


def test_kinds_within_people_explain_pictures_as_their_gaussian_does():
    group = torch.stack([torch.zeros(3), torch.tensor([8.0, -4.0, 2.0])])[:, None].repeat(1, 2, 1)
    variance = torch.tensor([[30.0, 20.0, 10.0], [4.0, 9.0, 1.0]]) ** 2
    parts = {name: getattr(PRIOR, name) for name in ("mean", "parity", "rest_variance")}
    prior = of_whole_body(
        **parts, basis=PRIOR.basis.mT.flatten(1), log_weight=torch.full((2, 2), 0.25).log(), centre=group,
        axes=PRIOR.axes.repeat(2, 1, 1), variance=variance, kind=PRIOR.kind.repeat(2, 1, 1),
    )  # fmt: skip
    components = dataclasses.replace(PriorFit.of(MODEL), prior=prior)
    human = human_of(COLOURS / 10)
    targets = targets_of(captured(human, BodyPose.rest(), [0.0]).views, [frames_of(human)], 64)
    everyone = components.everyone()
    precision, vector, misfit = components._information(everyone, targets)
    people, precision = components._kinds(None, None)[0], precision.double().numpy()
    mean = np.linalg.solve(precision, vector.double().numpy())  # the picture alone, as a Gaussian of weights
    height = (
        vector.double().numpy() @ mean / 2 - misfit + np.linalg.slogdet(2 * np.pi * np.linalg.inv(precision))[1] / 2
    )
    into = np.linalg.inv(people.factor.double().numpy())
    for number, found in enumerate(components.within(everyone, [(0, None), (1, 0)], targets)):
        spread = into.T @ np.diag(variance[number].double()) @ into + np.linalg.inv(precision)
        centre = (group[number, 0] - people.mean).double().numpy() @ into
        assert found.evidence == pytest.approx(height + multivariate_normal(centre, spread).logpdf(mean), rel=1e-3)
    assert found.group == 1


def test_the_voxels_follow_the_given_view_beyond_the_linear_fit(monkeypatch):
    human = human_of(COLOURS)
    noise = torch.rand(human.payload.rgb.shape, generator=torch.Generator().manual_seed(0))
    noisy = dataclasses.replace(human, payload=dataclasses.replace(human.payload, rgb=noise))
    person = captured(noisy, BodyPose.rest(), [0.0])
    (target,) = targets_of(person.views, [frames_of(human)], 128)
    starts = []
    monkeypatch.setattr(from_captures, "descend", lambda start, *how: starts.append(start) or descend(start, *how))
    found = reconstruct(MODEL, person).payload
    (linear,) = starts
    before, after = (
        (encode_srgb(drawn.rgb) - encode_srgb(target.rgba[..., :3])).square().mean()
        for drawn in (march(Primitives.place(target.frames, one), target.camera) for one in (linear, found))
    )
    assert after < 0.8 * before
    behind = frames_of(human).rotation[:, 2, 2] < -0.7
    assert (found.rgb[behind] - linear.rgb[behind]).abs().mean() < 0.01
    assert bool((found.density <= linear.density).all())
    assert bool((found.density < linear.density).any())


def test_a_seed_draws_the_residual_too(plain, monkeypatch):
    monkeypatch.setattr(from_captures, "descend", lambda start, *_: start)
    behind = frames_of(human_of(COLOURS)).rotation[:, 2, 2] < -0.7
    one, other = (human.payload.density[behind] for human in draw_humans(MODEL, plain[0], (1, 2)))
    assert (one - other).abs().mean() > 0.1  # coefficients are of colours alone
    components = PriorFit.of(MODEL)
    residual = components.sample_residual(COLOURS, torch.Generator().manual_seed(0))
    assert torch.allclose(PRIOR.outside(residual[None])[0], residual, atol=1e-5)
    *_, last = sample(MODEL, [0])
    assert float(residual.std()) == pytest.approx(float(PRIOR.split(last.x0)[1].std()), rel=0.1)


def test_what_components_cannot_draw_comes_from_the_network():
    model = tiny_model(SLOW)
    with torch.no_grad():
        model.denoiser.local.outer.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 2.0]))
    residual = PriorFit.of(model).mean_residual(COLOURS)
    assert torch.allclose(residual[3], torch.tensor(2 * 0.01**0.5), atol=0.01)  # in standard deviations of residuals
    assert residual[:3].abs().max() < 0.01


def test_a_model_without_person_components_is_refused():
    person = captured(human_of(COLOURS), BodyPose.rest(), [0.0])
    with refused(ValueError, "person components"):
        reconstruct(dataclasses.replace(MODEL, denoiser=torch.nn.Identity()), person)


def test_the_fit_after_the_encoder_draws_the_views_closer():
    model, person = tiny_encoder(), captured(human_of(COLOURS), BodyPose.rest(), [0.0, 1.6, 3.1])
    frames = [frames_of(human_of(COLOURS))] * 3

    def error(payload: Payload) -> float:
        drawn = [
            march(Primitives.place(frames[0], payload), one.camera) for one in targets_of(person.views, frames, 128)
        ]
        pairs = zip(drawn, targets_of(person.views, frames, 128), strict=True)
        return float(sum((one.rgb - target.rgba[..., :3]).square().mean() for one, target in pairs))

    encoded = model.encode(person.views, person.betas)
    fitted = encode_and_fit(model, person.views, person.betas)
    assert error(fitted) < 0.3 * error(encoded)
    assert not torch.equal(fitted.delta_scale, encoded.delta_scale)


def test_the_fit_draws_no_more_rays_than_an_image_of_256_pixels_has(monkeypatch):
    human, settings = human_of(COLOURS), []
    large = framing(place(human), 0.0, 600, 400)
    views = Views(torch.full((1, 400, 600, 4), 255, dtype=torch.uint8), stack([large]), BodyPose.rest())

    def noted(start: Payload, views: list, used: DescentSettings) -> Payload:
        settings.append(used)
        return start

    monkeypatch.setattr(from_captures, "descend", noted)
    model = tiny_encoder()
    encode_and_fit(model, views, BETAS)
    assert settings[0].stride == 3
    assert settings[0].largest_density == model.config.full_density


def test_images_without_the_subject_are_not_fitted():
    person = captured(human_of(COLOURS), BodyPose.rest(), [0.0])
    empty = dataclasses.replace(person.views, rgba=torch.zeros_like(person.views.rgba))
    encoded = tiny_encoder().encode(empty, BETAS)
    assert torch.equal(encode_and_fit(tiny_encoder(), empty, BETAS).density, encoded.density)


def test_boxes_of_the_released_code_stay_as_their_network_draws_them():
    small = dataclasses.replace(TINY, compat="released", detail="bottleneck", grid_entry="halving")
    torch.manual_seed(0)
    model = EncoderModel(Encoder(small).eval().requires_grad_(False), {})
    person = captured(human_of(COLOURS), BodyPose.rest(), [0.0])
    encoded = model.encode(person.views, BETAS)
    assert torch.equal(encode_and_fit(model, person.views, BETAS).rgb, encoded.rgb)
