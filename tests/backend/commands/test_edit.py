"""The editing commands as a user meets them: whole folders, or a sentence and nothing."""

import json

import numpy as np
import pytest
from primdiffusion import cli
from primdiffusion.body.model import default_body
from primdiffusion.human_file import load_human, save_human
from support.tiny import random_human, save_tiny_checkpoint, tiny_model

FILES = ["depth.png", "front.png", "person.human.safetensors", "side.png"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two people, a checkpoint and a painted region."""
    folder = tmp_path_factory.mktemp("people")
    for seed, name in ((1, "ann"), (2, "bob")):
        save_human(folder / f"{name}.human.safetensors", random_human(seed))
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
            ["transfer", "--source", "bob.human.safetensors", "--region", "top", "--checkpoint", "none.safetensors"],
            {"edit": "transfer_texture", "region": ["top"]},
        ),
        (
            ["transfer", "--source", "bob.human.safetensors", "--region", "top", "--harmonise", "0.4", "--steps", "2"],
            {"edit": "harmonise"},
        ),
    ],
)
def test_each_command_writes_a_whole_person_who_tells_what_was_done(line, tmp_path, capsys, command, edit):
    cli.main(line(*command))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    last = load_human(tmp_path / "out" / "person.human.safetensors").provenance["edits"][-1]
    assert {name: last[name] for name in edit} == edit
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'out'}  {edit['edit']}, ")


@pytest.mark.parametrize(
    ("command", "code", "sentence"),
    [
        (["vary", "--attributes", "species=cat"], 1, "knows no attribute 'species'"),
        (["inpaint"], 1, "region and weights"),
        (["inpaint", "--region", "top", "--checkpoint", "bob.human.safetensors"], 1, "choose another file"),
        (["transfer", "--region", "top"], 2, "source"),
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
