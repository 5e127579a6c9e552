"""The editing commands as a user meets them: whole folders, or a sentence and nothing."""

import json

import numpy as np
import pytest
import torch
from editing_people import anybody
from primdiffusion import cli
from primdiffusion.body.model import default_body
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing.regions import region_from_weights, region_of
from primdiffusion.human_file import load_human, save_human
from tiny_model import save_tiny_checkpoint, tiny_model

FILES = ["depth.png", "front.png", "person.human.safetensors", "side.png"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two people, a checkpoint and a painted region."""
    folder = tmp_path_factory.mktemp("people")
    for seed, name in ((1, "ann"), (2, "bob")):
        save_human(folder / f"{name}.human.safetensors", anybody(seed))
    save_tiny_checkpoint(folder / "tiny.safetensors")
    weights = (default_body().template[:, 1] > 0.2).float()
    np.savez(folder / "painted.npz", weights=weights)
    return folder


@pytest.fixture
def line(folder, tmp_path):
    """Arguments of a command on Ann, written to tmp_path / out."""

    def line(command: str, *more: str) -> list[str]:
        usual = {"--size": "32", "--checkpoint": str(folder / "tiny.safetensors")}
        common = ["--out", str(tmp_path / "out")]
        common += [word for name, value in usual.items() if name not in more for word in (name, value)]
        named = [str(folder / word) if word.endswith((".safetensors", ".npz")) else word for word in more]
        return [command, str(folder / "ann.human.safetensors"), *named, *common]

    return line


def same(one, two, where=slice(None)) -> bool:
    fields = ("rgb", "density", "delta_scale")
    return all(torch.equal(getattr(one.payload, name)[where], getattr(two.payload, name)[where]) for name in fields)


@pytest.mark.parametrize(
    ("command", "edit"),
    [
        (["vary", "--amount", "0.3", "--steps", "2", "--seed", "4"], {"edit": "vary", "amount": 0.3, "seed": 4}),
        (["interpolate", "bob.human.safetensors", "--fraction", "0.4", "--steps", "2"], {"edit": "interpolate"}),
        (
            ["inpaint", "--region", "top", "hair", "--steps", "2", "--attributes", "outfit=suit"],
            {"edit": "inpaint", "attributes": {"outfit": "suit"}},
        ),
        (
            ["transfer", "--source", "bob.human.safetensors", "--region", "top"],
            {"edit": "transfer_texture", "region": ["top"]},
        ),
    ],
)
def test_each_command_writes_a_whole_person_who_tells_what_was_done(line, tmp_path, capsys, command, edit):
    cli.main(line(*command))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    last = load_human(tmp_path / "out" / "person.human.safetensors").provenance["edits"][-1]
    assert {name: last[name] for name in edit} == edit
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'out'}  {edit['edit']}, ")


def test_inpaint_changes_the_painted_region_and_not_a_bit_besides(line, folder, tmp_path):
    cli.main(line("inpaint", "--weights", "painted.npz", "--steps", "2"))
    ann, edited = (
        load_human(path) for path in (folder / "ann.human.safetensors", tmp_path / "out" / "person.human.safetensors")
    )
    with np.load(folder / "painted.npz") as stored:
        painted = region_from_weights(torch.from_numpy(stored["weights"]))
    assert same(ann, edited, ~painted)
    assert not same(ann, edited, painted)
    assert torch.equal(ann.betas, edited.betas)


def test_transfer_of_a_garment_copies_shape_too_and_harmonising_changes_it_within_the_region(line, folder, tmp_path):
    shoes = region_of(["shoes"])
    take = ["transfer", "--source", "bob.human.safetensors", "--region", "shoes", "--what", "garment"]
    bob, ann = (load_human(folder / f"{name}.human.safetensors") for name in ("bob", "ann"))
    cli.main(line(*take))
    exact = load_human(tmp_path / "out" / "person.human.safetensors")
    assert same(exact, bob, shoes)
    cli.main(line(*take, "--harmonise", "0.4", "--steps", "2"))
    harmonised = load_human(tmp_path / "out" / "person.human.safetensors")
    assert not same(harmonised, bob, shoes)
    assert same(harmonised, ann, ~shoes)
    assert [edit["edit"] for edit in harmonised.provenance["edits"]] == ["transfer_garment", "harmonise"]


def test_a_transfer_needs_no_checkpoint(line, tmp_path):
    take = ["transfer", "--source", "bob.human.safetensors", "--region", "top"]
    cli.main(line(*take, "--checkpoint", "nowhere"))
    assert (tmp_path / "out" / "person.human.safetensors").exists()


@pytest.mark.parametrize(
    ("command", "code", "sentence"),
    [
        (["vary", "--seed", "seven"], 2, "seven"),
        (["vary", "--attributes", "species=cat"], 1, "knows no attribute 'species'"),
        (["interpolate", "tiny.safetensors"], 1, "without a human"),
        (["inpaint"], 1, "region and weights"),
        (["inpaint", "--region", "hat"], 1, "'hat': choose from face"),
        (["inpaint", "--region", "clothes", "skin", "hair"], 1, "the region is the whole human"),
        (["inpaint", "--weights", "ann.human.safetensors"], 1, "ann.human.safetensors"),
        (["inpaint", "--region", "top", "--checkpoint", "bob.human.safetensors"], 1, "choose another file"),
        (["transfer", "--region", "top"], 2, "source"),
        (["transfer", "--source", "bob.human.safetensors", "--region", "top", "--harmonise", "2"], 1, "harmonise is 2"),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_is_written(line, tmp_path, fails, command, code, sentence):
    failed = fails(*line(*command))
    assert failed.code == code
    assert sentence in failed.err
    assert code == 2 or failed.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_paint_of_another_body_is_rejected_with_the_number_of_vertices(line, folder, fails):
    np.savez(folder / "other_body.npz", weights=np.ones(6890, np.float32))
    error = fails(*line("inpaint", "--weights", "other_body.npz")).err
    assert "12196 vertices" in error
    assert "other_body.npz" in error


@pytest.mark.parametrize(
    "command", [["vary"], ["inpaint", "--region", "top"], ["interpolate", "bob.human.safetensors"]]
)
def test_memory_that_runs_out_mid_sample_leaves_nothing_and_names_what_to_lower(
    line, tmp_path, fails, monkeypatch, command
):
    calls, denoise = [], DiffusionModel.denoise

    def small_card(self, x, t, *more):
        calls.append(t)
        if len(calls) == 3:
            raise RuntimeError("[enforce fail at alloc_cpu.cpp:75] DefaultCPUAllocator: not enough memory: you tried")
        return denoise(self, x, t, *more)

    monkeypatch.setattr(DiffusionModel, "denoise", small_card)
    failed = fails(*line(*command, "--steps", "6"))
    assert (failed.code, len(calls)) == (1, 3)
    assert "memory" in failed.err
    assert not (tmp_path / "out").exists()


def test_an_interrupt_mid_sample_leaves_nothing(line, tmp_path, fails, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(DiffusionModel, "denoise", interrupted)
    assert fails(*line("vary", "--steps", "2")).code == cli.INTERRUPTED
    assert not (tmp_path / "out").exists()


def test_info_tells_all_that_a_file_says_of_a_person(line, tmp_path, capsys):
    cli.main(line("vary", "--steps", "2"))
    capsys.readouterr()
    cli.main(["info", str(tmp_path / "out" / "person.human.safetensors")])
    about = json.loads(capsys.readouterr().out)
    assert (about["format_version"], about["body"], len(about["betas"])) == (1, "default", 10)
    assert about["edits"][0]["edit"] == "vary"
    assert about["edits"][0]["checkpoint"] == tiny_model().card["name"]
    assert len(about["edits"][0]["checkpoint_sha256"]) == 64


def test_info_of_a_damaged_person_says_so_and_not_that_it_is_no_checkpoint(folder, tmp_path, fails):
    path = tmp_path / "cut.human.safetensors"
    path.write_bytes((folder / "ann.human.safetensors").read_bytes()[:-10])
    assert "generate the human again" in fails("info", path).err
