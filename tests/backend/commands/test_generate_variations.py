"""People to choose from: as generate and vary make them, with pictures, all or none."""

import itertools
from pathlib import Path

import pytest
import torch
from PIL import Image
from primdiffusion.commands.generate import variations
from primdiffusion.commands.output import PreviewBudget
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.checkpoint import load_checkpoint, save_checkpoint
from primdiffusion.editing.vary import vary
from primdiffusion.formats.requests import VariationsRequest
from primdiffusion.human import generate
from primdiffusion.human_file import load_human, save_human
from support.runs import ended_at_each_report
from support.tiny import model_of_two_kinds


@pytest.fixture
def model(checkpoint):
    return load_checkpoint(checkpoint, torch.device("cpu"))


class Listener:
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
        alone = generate(model, person.seed, 3, "dpmpp_2m", None, **asked)
        assert dict(kept.provenance) == dict(alone.provenance)
        assert torch.allclose(kept.payload.rgb, alone.payload.rgb, atol=1e-4)
        assert torch.allclose(kept.betas, alone.betas, atol=1e-4)
        assert Path(person.picture).is_file()
    written = [more for stage, *_, more in listener.reports if stage == "write"]
    assert [(more["index"], more["size"]) for more in written] == [(0, (32, 32)), (1, (32, 32)), (2, (32, 32))]


@pytest.mark.parametrize("around", [False, True])
def test_while_they_are_sampled_each_gets_its_picture_in_turn(checkpoint, model, tmp_path, monkeypatch, around):
    person = tmp_path / "person.human.safetensors"
    save_human(person, generate(model, 3, 2))
    of_whom, out = {"person": person} if around else {}, tmp_path / "out"
    grants = itertools.cycle([True, True, False])
    monkeypatch.setattr(PreviewBudget, "granted", lambda _: next(grants))
    listener = Listener()
    how = {"steps": 4, "checkpoint": checkpoint, "size": 16, **of_whom}
    variations(VariationsRequest(seeds=[1, 2, 3], out_dir=out, **how), Session(), listener)
    shown = [(step, more["index"]) for stage, step, _, more in listener.reports if stage == "sample" and more]
    assert shown == [(1, 0), (1, 1), (2, 2), (2, 0), (3, 1), (3, 2)]
    assert sorted({path.suffix for path in out.iterdir()}) == [".png", ".safetensors"]
    assert len(list(out.iterdir())) == 6, "pictures of the steps are gone"


def test_variants_of_a_person_are_those_that_vary_makes(checkpoint, model, tmp_path):
    person = tmp_path / "person.human.safetensors"
    save_human(person, generate(model, 3, 2))
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


def test_it_can_be_ended_at_every_report_and_then_leaves_nothing(checkpoint, tmp_path):
    request = VariationsRequest(seeds=[1, 2], out_dir=tmp_path / "out", steps=2, checkpoint=checkpoint, size=16)
    ended_at_each_report(lambda report: variations(request, Session(), report), tmp_path / "out")


@pytest.mark.parametrize("around", [False, True])
def test_humans_that_do_not_show_what_was_asked_for_are_named(tmp_path, around):
    model, path, person = model_of_two_kinds(), tmp_path / "two.safetensors", tmp_path / "a.human.safetensors"
    save_checkpoint(path, model, "linear")
    save_human(person, generate(model, 3, 2, attributes={"sex": "female"}))
    asked = {"sex": "male", "outfit": "jeans"}
    of_whom = {"person": person, "amount": 0.05} if around else {}
    request = VariationsRequest(
        seeds=[5, 6], out_dir=tmp_path / "out", steps=2, size=16, checkpoint=path, attributes=asked, **of_whom
    )
    warnings = variations(request, Session(), Listener()).warnings
    assert [warning.partition(": the human does not show ")[0] for warning in warnings] == ["seed 5", "seed 6"]
