"""Generating for a child, without the child: one human, several, and people to choose from."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion import cli
from primdiffusion.commands import generate as generate_module
from primdiffusion.commands import session
from primdiffusion.commands.generate import generate, variations
from primdiffusion.commands.output import PreviewBudget
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.checkpoint import load_checkpoint, save_checkpoint
from primdiffusion.diffusion.model import sample
from primdiffusion.diffusion.samplers import RELEASED_END
from primdiffusion.editing.vary import vary
from primdiffusion.formats.requests import Conditioning, GenerateRequest, VariationsRequest
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import decode_humans, framing, place
from primdiffusion.human import generate as generate_human
from primdiffusion.human_file import load_human, save_human
from primdiffusion.render.march import RELEASED
from primdiffusion.render.reference import march_reference
from support.errors import refused
from support.runs import ended_at_each_report
from support.tiny import model_of_two_kinds, save_tiny_checkpoint, save_tiny_encoder


@pytest.fixture
def only_sampling(monkeypatch):
    """Leaves out files and pictures."""
    monkeypatch.setattr(generate_module, "write_human", lambda *_, **__: None)


def test_time_left_is_the_mean_of_the_warm_steps_times_the_steps_left(checkpoint, tmp_path, monkeypatch, only_sampling):
    clock = itertools.chain([0.0, 10.0, 12.0, 14.0, 20.0], itertools.count(30.0))  # start, 4 steps, the rest
    monkeypatch.setattr("primdiffusion.commands.progress.time.perf_counter", lambda: next(clock))
    reports = []
    request = GenerateRequest(seed=1, out_dir=tmp_path, steps=4, checkpoint=checkpoint)
    generate(request, Session(), lambda *report: reports.append(report))
    assert [report for report in reports if report[0] == "sample"] == [
        ("sample", 0, 4, None),
        ("sample", 1, 4, None),
        ("sample", 2, 4, None),
        ("sample", 3, 4, 2.0),
        ("sample", 4, 4, 0.0),
    ]


@pytest.mark.parametrize(
    ("load", "kind", "save"),
    [("load_checkpoint", "model", save_tiny_checkpoint), ("load_encoder", "encoder", save_tiny_encoder)],
)
def test_a_model_stays_loaded_until_another_is_asked_for(tmp_path, monkeypatch, load, kind, save):
    loaded, read, one = [], getattr(session, load), Session()
    monkeypatch.setattr(session, load, lambda path, device: loaded.append(path) or read(path, device))
    first, second = (save(tmp_path / f"{name}.safetensors") for name in "ab")
    for path in (first, first, second, first):
        getattr(one, kind)(path)
    assert loaded == [first, second, first]


def test_a_request_can_be_ended_at_every_report(checkpoint, tmp_path):
    request = GenerateRequest(seed=1, out_dir=tmp_path / "out", steps=2, checkpoint=checkpoint, size=32)
    _, reports = ended_at_each_report(lambda report: generate(request, Session(), report), tmp_path / "out")
    assert [report[0] for report in reports] == ["load", "sample", "sample", "sample", "write", "write"]


def test_nothing_is_written_through_a_link_in_the_folder_of_several_humans(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out" / "seed_000003").symlink_to(tmp_path / "elsewhere")
    with refused(ValueError, "seed_000003"):
        cli.run(["generate", "--seed", "3", "--count", "2", "--out", str(tmp_path / "out")])
    assert not list((tmp_path / "elsewhere").iterdir())


def test_the_command_line_writes_compact_files(checkpoint, tmp_path):
    options = ["--checkpoint", str(checkpoint), "--steps", "1", "--size", "16", "--out", str(tmp_path)]
    cli.run(["generate", "--seed", "3", "--compact", *options])
    assert (tmp_path / "person.human.safetensors").stat().st_size < 2.2e6


def test_released_compositing_keeps_the_noise_of_ddims_last_level_and_encodes_previews(checkpoint, tmp_path):
    """The human by the formula of DDIM, its pictures by the float64 marcher."""
    for name in ("linear", "released"):
        cli.run([
            "generate", "--checkpoint", str(checkpoint), "--seed", "3", "--steps", "4", "--size", "24",
            "--out", str(tmp_path / name), "--compositing", name, "--sampler", "ddim",
        ])  # fmt: skip
    model = load_checkpoint(checkpoint)
    schedule = model.schedule
    *_, before, end = sample(model, [3], 4, "ddim", None, Conditioning.guidance)
    noise = (before.x - schedule.alpha_bar[end.t].sqrt() * end.x0) / (1 - schedule.alpha_bar[end.t]).sqrt()
    left = schedule.alpha_bar[0].sqrt() * end.x0 + (1 - schedule.alpha_bar[0]).sqrt() * noise
    (expected,) = decode_humans(model, left.to(end.x0), [3])
    found = {name: load_human(tmp_path / name / "person.human.safetensors") for name in ("linear", "released")}
    assert (found["released"].payload.rgb - expected.payload.rgb).abs().max() < 1e-4
    assert (found["released"].payload.rgb - found["linear"].payload.rgb).abs().max() > 1e-3
    assert found["released"].provenance["end"] == 0
    assert "end" not in found["linear"].provenance
    primitives = place(found["released"]).to(dtype=torch.float64)
    for name, yaw in (("front", 0), ("side", 90)):
        camera = framing(place(found["released"]), yaw, 24, 24).to(dtype=torch.float64)
        camera.intrinsics[:2, 2] += 0.5  # rays through corners of pixels
        encoded = dataclasses.replace(primitives, rgb=encode_srgb(primitives.rgb))
        rendering = march_reference(encoded, camera, RELEASED)
        assert ((rendering.alpha > 0.1) & (rendering.alpha < 0.9)).any()
        with Image.open(tmp_path / "released" / f"{name}.png") as picture:
            assert np.abs(np.asarray(picture) / 255 - rendering.rgb.numpy()).max() < 0.006
    with Image.open(tmp_path / "released" / "depth.png") as picture:
        assert picture.size == (24, 24)
        assert np.asarray(picture).max() > 100


def test_released_compositing_changes_no_other_sampler(checkpoint, tmp_path):
    made = []
    for compositing in ("linear", "released"):
        request = GenerateRequest(
            seed=1, out_dir=tmp_path / compositing, steps=2, checkpoint=checkpoint, size=8, sampler="dpmpp_2m",
            compositing=compositing,
        )  # fmt: skip
        generate(request, Session(), lambda *_: None)
        made.append(load_human(tmp_path / compositing / "person.human.safetensors"))
    assert torch.equal(made[0].payload.rgb, made[1].payload.rgb)
    assert made[0].provenance == made[1].provenance


def test_only_ddim_ends_above_the_clean_sample(checkpoint):
    with refused(ValueError, "dpmpp_2m"):
        generate_human(load_checkpoint(checkpoint), 1, 2, "dpmpp_2m", end=RELEASED_END)


def test_what_a_human_does_not_show_is_in_the_answer_and_on_stderr(tmp_path, capsys, only_sampling):
    path = tmp_path / "two_kinds.safetensors"
    save_checkpoint(path, model_of_two_kinds(), "linear")
    asked = {"sex": "female", "outfit": "suit"}
    request = GenerateRequest(seed=1, out_dir=tmp_path / "out", steps=2, checkpoint=path, attributes=asked)
    (warning,) = generate(request, Session(), lambda *_, **__: None).warnings
    assert "instead" in warning
    words = ["--seed", "1", "--count", "2", "--steps", "2", "--checkpoint", str(path), "--out", str(tmp_path / "two")]
    cli.main(["generate", *words, "--attributes", "sex=female", "outfit=suit"])
    said = capsys.readouterr().err
    assert f"primdiffusion: warning: seed 1: {warning}\n" in said
    assert "primdiffusion: warning: seed 2: the human does not show" in said
    cli.main(["generate", *words, "--attributes", "outfit=suit"])
    assert "warning" not in capsys.readouterr().err


@pytest.fixture
def model(checkpoint):
    return load_checkpoint(checkpoint, torch.device("cpu"))


class Listener:
    """Keeps what is reported, with the size of each picture."""

    def __init__(self):
        self.reports = []

    def __call__(self, stage, step, total, eta_s, /, **more):
        if "picture" in more:
            with Image.open(more["picture"]) as picture:
                more["size"] = picture.size
        self.reports.append((stage, step, total, more))


def test_each_person_is_the_one_that_generate_makes_of_the_seed(checkpoint, model, tmp_path):
    listener = Listener()
    asked = {"attributes": {"outfit": "suit", "height": 1.7}, "guidance": 2.0}
    how = {"steps": 3, "sampler": "dpmpp_2m", "checkpoint": checkpoint, "size": 32, **asked}
    result = variations(
        VariationsRequest(seeds=[5, 2**63 - 1, 6], out_dir=tmp_path / "out", **how), Session(), listener
    )
    assert [person.seed for person in result.people] == [5, 2**63 - 1, 6]
    assert len(list((tmp_path / "out").iterdir())) == 6
    for person in result.people:
        kept = load_human(person.person)
        alone = generate_human(model, person.seed, 3, "dpmpp_2m", None, **asked)
        assert dict(kept.provenance) == dict(alone.provenance)
        assert torch.allclose(kept.payload.rgb, alone.payload.rgb, atol=1e-4)
        assert torch.allclose(kept.betas, alone.betas, atol=1e-4)
        assert Path(person.picture).is_file()
    written = [more for stage, *_, more in listener.reports if stage == "write"]
    assert [(more["index"], more["size"]) for more in written] == [(0, (32, 32)), (1, (32, 32)), (2, (32, 32))]


@pytest.mark.parametrize("around", [False, True])
def test_while_they_are_sampled_each_gets_its_picture_in_turn(checkpoint, model, tmp_path, monkeypatch, around):
    person = tmp_path / "person.human.safetensors"
    save_human(person, generate_human(model, 3, 2))
    of_whom, out = {"person": person} if around else {}, tmp_path / "out"
    grants = itertools.cycle([True, True, False])
    monkeypatch.setattr(PreviewBudget, "allows", lambda _: next(grants))
    listener = Listener()
    how = {"steps": 4, "checkpoint": checkpoint, "size": 16, **of_whom}
    variations(VariationsRequest(seeds=[1, 2, 3], out_dir=out, **how), Session(), listener)
    shown = [(step, more["index"]) for stage, step, _, more in listener.reports if stage == "sample" and more]
    assert shown == [(1, 0), (1, 1), (2, 2), (2, 0), (3, 1), (3, 2)]
    assert sorted({path.suffix for path in out.iterdir()}) == [".png", ".safetensors"]
    assert len(list(out.iterdir())) == 6, "pictures of the steps are gone"


def test_variants_of_a_person_are_those_that_vary_makes(checkpoint, model, tmp_path):
    person = tmp_path / "person.human.safetensors"
    save_human(person, generate_human(model, 3, 2))
    how = {"steps": 5, "checkpoint": checkpoint, "size": 16, "person": person, "amount": 0.8}
    result = variations(VariationsRequest(seeds=[8, 9], out_dir=tmp_path / "out", **how), Session(), Listener())
    for made in result.people:
        kept, alone = load_human(made.person), vary(model, load_human(person), 0.8, made.seed, 5)
        assert torch.allclose(kept.payload.rgb, alone.payload.rgb, atol=1e-4)
        assert torch.equal(kept.betas, alone.betas)
        assert kept.provenance["edits"][0]["seed"] == made.seed
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        f"{seed}.{ending}" for seed in (8, 9) for ending in ("human.safetensors", "png")
    ]


def test_variations_can_be_ended_at_every_report_and_then_leave_nothing(checkpoint, tmp_path):
    request = VariationsRequest(seeds=[1, 2], out_dir=tmp_path / "out", steps=2, checkpoint=checkpoint, size=16)
    ended_at_each_report(lambda report: variations(request, Session(), report), tmp_path / "out")


@pytest.mark.parametrize("around", [False, True])
def test_humans_that_do_not_show_what_was_asked_for_are_named(tmp_path, around):
    model, path, person = model_of_two_kinds(), tmp_path / "two.safetensors", tmp_path / "a.human.safetensors"
    save_checkpoint(path, model, "linear")
    save_human(person, generate_human(model, 3, 2, attributes={"sex": "female"}))
    asked = {"sex": "male", "outfit": "jeans"}
    of_whom = {"person": person, "amount": 0.05} if around else {}
    request = VariationsRequest(
        seeds=[5, 6], out_dir=tmp_path / "out", steps=2, size=16, checkpoint=path, attributes=asked, **of_whom
    )
    warnings = variations(request, Session(), Listener()).warnings
    assert [warning.partition(": the human does not show ")[0] for warning in warnings] == ["seed 5", "seed 6"]
